"""What Draco has packed is read as the plain file is; damaged data is refused."""

import random
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from gltf_samples import LIFT, SQUARE, Builder, square

from torchface.errors import FileFormatError, MissingExtraError
from torchface.io import load_mesh, load_rig
from torchface.io.gltf.gltf_document import document_of, read_document
from torchface.io.gltf.performance_animation import Performance, performed_glb

draco = pytest.importorskip("DracoPy", reason="DracoPy is not installed")
UVS = np.array([[0, 0], [1, 0], [1, 1], [0, 0.25]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


def encoded() -> bytes:
    data: bytes = draco.encode(
        SQUARE.astype(np.float32), faces=TRIANGLES, quantization_bits=16, preserve_order=True, tex_coord=UVS
    )
    return data


def packed(data: bytes, count: int = 4) -> Builder:
    """A square whose shapes are plain and whose points lie in what Draco packs."""
    build = square(["jawOpen", "jawRight"])
    primitive = build.root["meshes"][0]["primitives"][0]
    numbers = {one["attribute_type"]: one["unique_id"] for one in draco.decode(encoded()).attributes}
    primitive["attributes"]["POSITION"] = build.bare(componentType=5126, count=count, type="VEC3")
    primitive["attributes"]["TEXCOORD_0"] = build.bare(componentType=5126, count=count, type="VEC2")
    primitive["indices"] = build.bare(componentType=5125, count=6, type="SCALAR")
    attributes = {"POSITION": numbers[0], "TEXCOORD_0": numbers[3]}
    extension = {"bufferView": build.view(data), "attributes": attributes}
    primitive["extensions"] = {"KHR_draco_mesh_compression": extension}
    return build


def test_points_triangles_and_coordinates_are_read(tmp_path: Path) -> None:
    build = packed(encoded())
    path = build.save(tmp_path / "face.gltf", extensionsRequired=["KHR_draco_mesh_compression"])
    rig = load_rig(path)
    np.testing.assert_allclose(rig.neutral.vertices, SQUARE * 1000, atol=0.05)
    np.testing.assert_allclose(rig.deltas[0], LIFT * 1000, atol=1e-3)
    mesh = load_mesh(path)
    corners = mesh.uvs[mesh.uv_faces]
    np.testing.assert_allclose(corners[1], [[0, 1], [1, 0], [0, 0.75]], atol=1e-3)


def test_an_eye_whose_packed_skin_looks_by_shapes_is_not_turned_too(tmp_path: Path) -> None:
    build = square(["eyeLookUpLeft", "jawRight"])
    primitive = build.root["meshes"][0]["primitives"][0]
    skin = {"JOINTS_0": np.full((4, 4), (0, 1, 1, 1), np.uint8), "WEIGHTS_0": np.eye(4, dtype=np.float32)[[0] * 4]}
    data = draco.encode(
        SQUARE.astype(np.float32),
        faces=TRIANGLES,
        preserve_order=True,
        generic_attributes=dict(zip((11, 12), skin.values(), strict=True)),
    )
    for name, kind in zip(skin, (5121, 5126), strict=True):
        primitive["attributes"][name] = build.bare(componentType=kind, count=4, type="VEC4")
    packed_skin = {"bufferView": build.view(data), "attributes": dict(zip(skin, (11, 12), strict=True))}
    primitive["extensions"] = {"KHR_draco_mesh_compression": packed_skin}
    build.root["nodes"] = [{"mesh": 0, "skin": 0}, {"name": "Head", "children": [2]}, {"name": "LeftEye"}]
    build.root |= {"skins": [{"joints": [2, 1]}], "scenes": [{"nodes": [0, 1]}]}
    document = read_document(build.save(tmp_path / "face.gltf"))
    played = Performance(np.arange(2.0), ("jawOpen",), np.zeros((2, 1), np.float32), np.full((2, 9), 0.1))
    root = document_of(tmp_path / "page.glb", performed_glb(document, played)).root
    turned = [one["target"]["node"] for one in root["animations"][0]["channels"] if one["target"]["path"] == "rotation"]
    assert turned == [1]


def test_other_counts_damaged_data_and_a_missing_package_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(FileFormatError, match=r"\(4, 3\) numbers that Draco unpacks, expected \(5, 3\)"):
        load_rig(packed(encoded(), count=5).save(tmp_path / "face.gltf"))
    with pytest.raises(FileFormatError, match=r"broken data .* expected what Draco packs"):
        load_rig(packed(b"DRACO" + bytes(40)).save(tmp_path / "face.gltf"))
    draw = random.Random(0)
    for _ in range(100):
        mutated = bytearray(encoded())
        for at in draw.choices(range(len(mutated)), k=draw.choice((1, 3))):
            mutated[at] = draw.randrange(256)
        with suppress(FileFormatError):
            load_rig(packed(bytes(mutated)).save(tmp_path / "face.gltf"))
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(MissingExtraError, match="Draco compression needs DracoPy"):
        load_rig(packed(encoded()).save(tmp_path / "face.gltf"))
