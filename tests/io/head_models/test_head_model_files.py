"""Tests of the readers of others' head models: planted files of each layout, and malformed ones of each."""

import pickle
import subprocess
import sys
import types
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch
from mutation import check_reader
from safetensors.numpy import save_file

from planted.published_heads import (
    PEOPLE,
    expression_basis,
    flame_arrays,
    gnm_arrays,
    gnm_landmarks,
    head,
    identity_modes,
    mhr_arrays,
    write_basel,
    write_eos,
)
from torchface.errors import FileFormatError
from torchface.io.head_models.head_model_files import is_head_model_file, load_head_model_file
from torchface.rig import BlendshapeRig

ARRAYS: dict[str, Callable[[BlendshapeRig], dict[str, Any]]] = {
    "flame": flame_arrays,
    "gnm": gnm_arrays,
    "mhr": mhr_arrays,
}
NEEDED = {
    "flame": ("v_template", "shapedirs", "f"),
    "gnm": ("template_vertex_positions", "vertex_identity_basis", "triangles", "expression_basis"),
    "mhr": ("base_shape", "shape_vectors", "faces"),
}


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return head()


@pytest.fixture(scope="module")
def arrays(rig: BlendshapeRig) -> dict[str, dict[str, Any]]:
    return {name: make(rig) for name, make in ARRAYS.items()}


@pytest.mark.parametrize("name", ["flame", "gnm", "mhr", "basel", "eos"])
def test_each_layout_gives_the_planted_head(
    name: str, rig: BlendshapeRig, arrays: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    path = tmp_path / {"basel": "model.h5", "eos": "model.bin"}.get(name, "model.npz")
    if name == "eos":
        write_eos(rig, path)
    elif name == "basel":
        pytest.importorskip("h5py")
        write_basel(rig, path)
    else:
        np.savez(path, **arrays[name])
    assert is_head_model_file(path)
    model = load_head_model_file(path)
    assert torch.allclose(model.neutral.vertices, rig.vertices, atol=1e-3)
    assert torch.equal(model.neutral.faces, rig.neutral.faces)
    assert torch.allclose(model.identity[:PEOPLE], identity_modes(), atol=2e-3)
    assert len(model.identity) == {"flame": 300, "gnm": PEOPLE, "mhr": 45, "basel": PEOPLE, "eos": PEOPLE}[name]
    if name == "mhr":
        assert model.expression_names[24] == "jawDrop"
        assert torch.allclose(model.expressions[24], rig.deltas[rig.index(["jawOpen"])[0]], atol=1e-3)
    else:
        assert torch.allclose(model.expressions, expression_basis(rig), atol=2e-3)


def test_damaged_files_of_eos_are_refused_and_read_no_more_than_they_hold(rig: BlendshapeRig, tmp_path: Path) -> None:
    path = tmp_path / "sfm.bin"
    write_eos(rig, path)
    whole = path.read_bytes()
    model = load_head_model_file(path)
    assert torch.equal(model.landmarks.on(model.neutral.vertices), rig.vertices[rig.neutral.landmarks])
    size = len(rig.vertices) * 3
    damaged = {
        "truncated": whole[: len(whole) // 3],
        "a gigabyte": whole[:4] + np.array([3 * 2**26, 1], "<i4").tobytes() + whole[12:],
        "NaN": whole[:12] + np.full(1, np.nan, "<f4").tobytes() + whole[16:],
        "basis": whole[: 12 + 4 * size] + np.array([7, 7], "<i4").tobytes() + whole[20 + 4 * size :],
    }
    for name, data in damaged.items():
        path.write_bytes(data)
        with pytest.raises(FileFormatError, match=r"sfm\.bin: found"):
            load_head_model_file(path)
        assert name


def test_flame_is_read_from_safetensors_too(arrays: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    plain = {
        name: np.ascontiguousarray(v, dtype=np.int64 if v.dtype.kind in "iu" else np.float32)
        for name, v in arrays["flame"].items()
    }
    save_file(plain, tmp_path / "flame.safetensors")
    model = load_head_model_file(tmp_path / "flame.safetensors")
    assert model.joints.names == ("root", "neck", "jaw", "left_eye", "right_eye")
    assert model.joints.parents == (-1, 0, 1, 1, 1)


def test_flame_turns_its_jaw_and_eyes_about_their_joints(
    rig: BlendshapeRig, arrays: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    np.savez(tmp_path / "flame.npz", **arrays["flame"])
    model = load_head_model_file(tmp_path / "flame.npz")
    rotations = torch.zeros(2, 5, 3)
    rotations[0, 2, 0] = 0.3
    rotations[1, 3, 1] = 0.4
    posed = model.posed(model.neutral.vertices, torch.zeros(2, 51), rotations)
    notes = rig.neutral.annotations
    chin = rig.neutral.landmarks[8]
    assert float(posed[0, chin, 1] - rig.vertices[chin, 1]) < -15
    ball = notes.regions["eyeball_left"]
    middle = rig.vertices[ball].mean(0)
    assert torch.allclose(posed[1, ball].mean(0), middle, atol=0.01)
    assert float((posed[1, ball] - rig.vertices[ball]).norm(dim=1).max()) > 2
    assert torch.allclose(posed[1, notes.regions["nose"]], rig.vertices[notes.regions["nose"]], atol=1e-3)


def test_landmarks_are_read_of_the_files_beside(
    rig: BlendshapeRig, arrays: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    truth = rig.vertices[rig.neutral.landmarks]
    np.savez(tmp_path / "gnm_head.npz", **arrays["gnm"])
    gnm_landmarks(rig, tmp_path / "head_sparse_68.txt")
    gnm = load_head_model_file(tmp_path / "gnm_head.npz")
    assert torch.allclose(gnm.landmarks.on(gnm.neutral.vertices), truth, atol=1e-3)  # its contour in iBUG's order
    beside = ("lmk_face_idx", "lmk_b_coords")
    np.savez(tmp_path / "flame.npz", **{name: v for name, v in arrays["flame"].items() if name not in beside})
    assert load_head_model_file(tmp_path / "flame.npz").landmarks is None
    np.savez(tmp_path / "flame_static_embedding.npz", **{name: arrays["flame"][name] for name in beside})
    flame = load_head_model_file(tmp_path / "flame.npz")
    assert flame.landmarks.rows.tolist() == list(range(17, 68))
    assert torch.allclose(flame.landmarks.on(flame.neutral.vertices), truth[17:], atol=1e-3)


class _Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("was_run"),)


@pytest.mark.parametrize("name", ["flame2023.pkl", "gnm_head.npz", "generic_model.safetensors", "landmarks.npy"])
def test_a_pickle_of_whatever_name_is_not_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    if name.endswith(".npy"):
        np.save(name, np.array([_Evil()], dtype=object))
    else:
        Path(name).write_bytes(pickle.dumps(_Evil()))
    with pytest.raises(FileFormatError, match=r"pickle.*process of its own"):
        load_head_model_file(name)
    assert not Path("was_run").exists()


def test_an_array_of_objects_in_an_archive_is_not_run(
    arrays: dict[str, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("flame.npz", **(arrays["flame"] | {"shapedirs": np.array([_Evil()], dtype=object)}))
    with pytest.raises(FileFormatError, match="shapedirs of O"):
        load_head_model_file("flame.npz")
    assert not Path("was_run").exists()


def _small(found: dict[str, Any]) -> dict[str, Any]:
    """Few ways to differ, so that files are written quickly."""
    return {key: value[..., :310] if key == "shapedirs" else value for key, value in found.items()}


@pytest.mark.parametrize(("name", "key"), [(name, key) for name, keys in NEEDED.items() for key in keys])
@pytest.mark.parametrize("harm", ["missing", "shape", "nan"])
def test_wrong_arrays_are_named(
    name: str, key: str, harm: str, arrays: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    found = _small(arrays[name])
    if harm == "missing":
        del found[key]
    elif harm == "shape":
        found[key] = found[key][:, :2]
    else:
        found[key] = found[key].astype(np.float32)
        found[key].flat[5] = np.nan
    np.savez(tmp_path / "model.npz", **found)
    with pytest.raises(FileFormatError, match="expected") as caught:
        load_head_model_file(tmp_path / "model.npz")
    assert str(tmp_path / "model.npz") in str(caught.value)
    if harm != "missing":
        assert key in str(caught.value)


def test_a_gigabyte_announced_is_refused_before_it_is_taken(arrays: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    """The archive's entry says 40 GB in its header and holds a hundred bytes."""
    np.savez(tmp_path / "flame.npz", **_small(arrays["flame"]))
    path = tmp_path / "huge.npz"
    with zipfile.ZipFile(tmp_path / "flame.npz") as source, zipfile.ZipFile(path, "w") as target:
        for entry in source.infolist():
            if entry.filename == "shapedirs.npy":
                with target.open("shapedirs.npy", "w") as file:
                    count = len(arrays["flame"]["v_template"])
                    header = {"descr": "<f8", "fortran_order": False, "shape": (count, 3, 300_000)}
                    np.lib.format.write_array_header_1_0(file, header)
                    file.write(bytes(100))
            else:
                target.writestr(entry, source.read(entry))
    with pytest.raises(FileFormatError, match=r"shapedirs of \d{11} bytes, expected at most"):
        load_head_model_file(path)


def test_an_archive_that_ends_early_is_refused(arrays: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    path = tmp_path / "flame.npz"
    np.savez(path, **_small(arrays["flame"]))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(FileFormatError, match="found no readable arrays"):
        load_head_model_file(path)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("shape/model/mean", np.zeros(7), "a mean of 7 numbers"),
        ("shape/model/pcaBasis", np.zeros((3, 2)), "pcaBasis"),
        ("shape/model/pcaVariance", np.full(PEOPLE, np.nan), "NaN"),
        ("shape/representer/cells", np.full((3, 2), 10**6), "triangles of vertices beyond"),
        ("metadata/landmarks/json", np.frombuffer(b"{]", np.uint8), "landmarks"),
    ],
)
def test_wrong_data_sets_of_basel_are_named(
    key: str, value: Any, said: str, rig: BlendshapeRig, tmp_path: Path
) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "model.h5"
    write_basel(rig, path)
    with h5py.File(path, "a") as file:
        del file[key]
        file[key] = value
    with pytest.raises(FileFormatError, match=said):
        load_head_model_file(path)


def test_links_out_of_a_basel_file_and_giants_are_refused(rig: BlendshapeRig, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    for harm in ("link", "giant"):
        path = tmp_path / f"{harm}.h5"
        write_basel(rig, path)
        with h5py.File(path, "a") as file:
            del file["shape/model/pcaBasis"]
            if harm == "link":
                file["shape/model/pcaBasis"] = h5py.ExternalLink("/etc/passwd", "x")
            else:
                file.create_dataset("shape/model/pcaBasis", (rig.vertices.numel(), 10**7), "f4", chunks=(64, 64))
        with pytest.raises(FileFormatError, match="a link in place" if harm == "link" else "bytes, expected at most"):
            load_head_model_file(path)


class Ch:
    """Stands in for chumpy's class, which FLAME's older pickles hold."""

    def __init__(self, x: np.ndarray) -> None:
        self.x = x


def test_the_pages_script_converts_a_pickle_and_runs_nothing(
    arrays: dict[str, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (Path(__file__).parents[3] / "docs" / "how_to" / "head_models.md").read_text()
    script = page.split("```python")[1].split("```")[0]
    (tmp_path / "convert.py").write_text(script)
    held = dict(_small(arrays["flame"]))
    held["J_regressor"] = scipy.sparse.csc_matrix(held["J_regressor"])
    chumpy = types.ModuleType("chumpy")
    monkeypatch.setitem(sys.modules, "chumpy", chumpy)
    monkeypatch.setattr(chumpy, "Ch", Ch, raising=False)
    monkeypatch.setattr(Ch, "__module__", "chumpy")
    held["shapedirs"] = Ch(held["shapedirs"])
    for name, document in (("good", held), ("evil", {"v_template": _Evil()})):
        (tmp_path / f"{name}.pkl").write_bytes(pickle.dumps(document, protocol=2))
    done = [
        subprocess.run([sys.executable, "convert.py", f"{name}.pkl", f"{name}.npz"], cwd=tmp_path, capture_output=True)
        for name in ("good", "evil")
    ]
    assert done[0].returncode == 0, done[0].stderr
    model = load_head_model_file(tmp_path / "good.npz")
    assert (len(model.identity), len(model.expressions)) == (300, 10)
    assert b"is not an array" in done[1].stderr
    assert not (tmp_path / "was_run").exists()


def test_a_mutated_archive_is_read_or_refused(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    few = {
        "v_template": generator.normal(size=(12, 3)).astype(np.float32),
        "shapedirs": generator.normal(size=(12, 3, 302)).astype(np.float32),
        "f": generator.integers(0, 12, (8, 3)),
    }
    np.savez(tmp_path / "flame.npz", **few)
    check_reader(load_head_model_file, [tmp_path / "flame.npz"], ".npz")


def test_a_header_that_is_no_python_is_refused(tmp_path: Path) -> None:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (4, 3), }" + b" " * 50 + b"(\n"
    (tmp_path / "v.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(48))
    with pytest.raises(FileFormatError, match="found no readable arrays"):
        load_head_model_file(tmp_path / "v.npy")


@pytest.mark.bench
def test_eos_itself_reads_the_planted_file_and_its_own_is_read(rig: BlendshapeRig, tmp_path: Path) -> None:
    models = pytest.importorskip("eos").morphablemodel
    write_eos(rig, tmp_path / "planted.bin")
    model = models.load_model(str(tmp_path / "planted.bin"))
    mean = np.asarray(model.get_shape_model().get_mean()).reshape(-1, 3)
    assert np.array_equal(mean, rig.vertices.numpy())
    models.save_model(model, str(tmp_path / "saved.bin"))
    saved, planted = (load_head_model_file(tmp_path / name) for name in ("saved.bin", "planted.bin"))
    assert torch.equal(saved.expressions, planted.expressions)
    assert saved.expression_names == planted.expression_names
