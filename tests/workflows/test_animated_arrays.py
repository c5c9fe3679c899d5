"""Archives of vertices and faces: read in every layout of NumPy's; damaged and built ones are refused."""

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from torchface.errors import FileFormatError
from torchface.workflows.animated_meshes import is_animation, load_animated

RANDOM = np.random.default_rng(0)
VERTICES = RANDOM.random((4, 5, 3), dtype=np.float32)
FACES = np.array([[0, 1, 2], [2, 3, 4]])


def npy(shape: str = "(4, 5, 3)", kind: str = "'<f4'", data: bytes = VERTICES.tobytes()) -> bytes:
    header = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def archive(path: Path, vertices: bytes) -> Path:
    faces = io.BytesIO()
    np.save(faces, FACES)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("../vertices.npy", npy(shape="(1, 5, 3)", data=bytes(60)))
        file.writestr("vertices.npy", vertices)
        file.writestr("faces.npy", faces.getvalue())
    return path


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8"])
def test_every_layout_is_read(tmp_path: Path, kind: str, order: str) -> None:
    vertices = np.asarray(VERTICES.astype(kind), order=order)
    np.savez_compressed(tmp_path / "a.npz", vertices=vertices, faces=FACES)
    assert is_animation(tmp_path / "a.npz")
    found = load_animated(tmp_path / "a.npz")
    np.testing.assert_array_equal(found.read(1, 3), VERTICES[1:3])
    np.testing.assert_array_equal(found.neutral.faces, FACES)


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        (f"({10**200}, {10**200}, 3)", "'<f4'"),
        (f"({10**400}, 3, 3)", "'<f4'"),
        ("(-1, -20, 3)", "'<f4'"),
        ("(-4, 5, 3)", "'<f4'"),
        ("(True, 5, 3)", "'<f4'"),
        ("(4, 5, 3)", "'|O'"),
        ("(4, 5, 3)", "[('a', '<f4'), ('b', '|O')]"),
        ("(4, 5, 3)", "'<c8'"),
        ("(4, 5, 3)", "'' + " + "-" * 9000 + "1"),
    ],
)
def test_built_headers_are_refused(tmp_path: Path, shape: str, kind: str) -> None:
    with pytest.raises(FileFormatError, match=r"a\.npz"):
        load_animated(archive(tmp_path / "a.npz", npy(shape, kind)))


def test_damaged_archives_are_refused_or_read(tmp_path: Path) -> None:
    whole = archive(tmp_path / "a.npz", npy()).read_bytes()
    refused = 0
    for _ in range(300):
        damaged = bytearray(whole)
        for place in RANDOM.integers(len(whole), size=2):
            damaged[place] = RANDOM.integers(256)
        (tmp_path / "b.npz").write_bytes(damaged)
        try:
            load_animated(tmp_path / "b.npz")
        except FileFormatError:
            refused += 1
    assert refused > 100


def test_what_would_fill_the_memory_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """40 MB of zeros in 40 KB."""
    count = 10 * 2**20 // 15
    with pytest.raises(FileFormatError, match=r"found vertices of 419430\d\d bytes, expected at most 5\d{6} "):
        load_animated(archive(tmp_path / "a.npz", npy(f"({count}, 5, 3)", data=bytes(60 * count))))


def test_arrays_are_in_the_unit_that_is_said(tmp_path: Path) -> None:
    path = archive(tmp_path / "a.npz", npy())
    np.testing.assert_allclose(load_animated(path, unit="m").read(0, 4), 1000 * VERTICES, rtol=1e-6)
