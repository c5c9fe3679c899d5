from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from rig_samples import quad_sheet, rigs, sheet_rig, sheet_take

from planted.glb_files import unpacked
from torchface import BlendshapeRig, Mesh, Take, Track, load_mesh, load_rig, save_animation, save_mesh, save_rig
from torchface.errors import FileFormatError, NameMismatchError, TopologyError, ValueRangeError

MICROMETRES_10 = 1e-2  # millimetres: the 1e-5 m that a round trip may cost


def assert_same_mesh(found: Mesh, expected: Mesh) -> None:
    assert (found.vertices - expected.vertices).abs().max() <= MICROMETRES_10
    assert torch.equal(found.faces, expected.faces)
    widest = 3 if expected.polygons is None else int((expected.polygons >= 0).sum(1).max())
    if expected.polygons is not None:
        assert torch.equal(found.polygons, expected.polygons[:, :widest])
    if expected.uvs is None:
        assert found.uvs is None
    else:
        assert (found.uvs[found.uv_faces] - expected.uvs[expected.uv_faces]).abs().max() <= 1e-6
    if expected.colors is None:
        assert found.colors is None
    else:
        assert (found.colors - expected.colors).abs().max() <= 1e-5


def assert_same_annotations(found: Mesh, expected: Mesh) -> None:
    a, b = found.annotations, expected.annotations
    if b is None:
        assert a is None
        return
    for name in ("landmarks", "mirror", "contacts"):
        ours, theirs = getattr(a, name), getattr(b, name)
        assert (ours is None) == (theirs is None)
        assert ours is None or torch.equal(ours, theirs)
    assert list(a.regions) == list(b.regions)
    assert all(torch.equal(a.regions[name], mask) for name, mask in b.regions.items())


@settings(max_examples=25)
@given(rig=rigs())
def test_any_rig_comes_back_from_glb(rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "any.glb"
    save_rig(rig, path)
    found = load_rig(path)
    assert found.names == rig.names
    assert (found.deltas - rig.deltas).abs().max() <= MICROMETRES_10
    assert_same_mesh(found.neutral, rig.neutral)
    assert_same_annotations(found.neutral, rig.neutral)


def test_the_texture_and_the_mesh_alone_come_back(tmp_path: Path) -> None:
    mesh = quad_sheet()
    save_mesh(mesh, tmp_path / "sheet.glb")
    found = load_mesh(tmp_path / "sheet.glb")
    assert_same_mesh(found, mesh)
    assert_same_annotations(found, mesh)
    assert (found.texture - mesh.texture).abs().max() <= 0.5 / 255 + 1e-6
    assert found.vertices.is_contiguous()
    assert found.vertices.dtype == torch.float32


def test_another_reader_finds_metres_and_the_same_surface(tmp_path: Path) -> None:
    rig = sheet_rig()
    save_rig(rig, tmp_path / "rig.glb")
    other = trimesh.load(tmp_path / "rig.glb", force="mesh", process=False)
    ours = rig.neutral.vertices[rig.neutral.faces].numpy() / 1000
    assert np.abs(other.vertices[other.faces] - ours).max() < 1e-6


def test_shapes_are_written_sparse_where_that_is_smaller(tmp_path: Path) -> None:
    rig = sheet_rig()
    save_rig(rig, tmp_path / "rig.glb")
    root = unpacked(tmp_path / "rig.glb")[0]
    targets = [root["accessors"][target["POSITION"]] for target in root["meshes"][0]["primitives"][0]["targets"]]
    assert [("sparse" in target, "bufferView" in target) for target in targets] == [
        (True, False),
        (False, True),
        (False, False),
    ]
    # The seam runs along the middle row, so its vertices stand twice; the one that moves in the first shape do not.
    assert targets[0]["sparse"]["count"] == 3
    assert targets[0]["count"] == len(rig.neutral.vertices) + 6


def test_normals_are_unit_and_smooth_across_the_seam(tmp_path: Path) -> None:
    save_rig(sheet_rig(), tmp_path / "rig.glb")
    other = trimesh.load(tmp_path / "rig.glb", force="mesh", process=False)
    root, data = unpacked(tmp_path / "rig.glb")
    accessor = root["accessors"][root["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]]
    offset = root["bufferViews"][accessor["bufferView"]]["byteOffset"]
    normals = np.frombuffer(data, "<f4", accessor["count"] * 3, offset).reshape(-1, 3)
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-6
    places = {}
    for place, normal in zip(np.round(other.vertices, 6).tolist(), normals, strict=True):
        assert np.array_equal(places.setdefault(tuple(place), normal), normal)
    assert len(places) == 30


def test_vertices_weld_by_movement_where_another_program_dropped_our_marks(tmp_path: Path) -> None:
    """Two vertices at one place stay two when they move apart, as lips do, and become one when they never do."""
    rig = sheet_rig()
    vertices = rig.neutral.vertices.clone()
    vertices[1] = vertices[0]
    rig = BlendshapeRig(rig.neutral.with_vertices(vertices), rig.deltas, rig.names)
    save_rig(rig, tmp_path / "rig.glb")
    data = (tmp_path / "rig.glb").read_bytes()
    (tmp_path / "other.glb").write_bytes(data.replace(b"_VERTEX_ID", b"_ANOTHER_A"))
    found = load_rig(tmp_path / "other.glb")
    assert len(found.neutral.vertices) == len(vertices)
    moved = torch.tensor([[0.3, 0.7, 0.2]])
    corners, expected = found(moved)[0][found.neutral.faces], rig(moved)[0][rig.neutral.faces]
    assert (corners - expected).abs().max() <= MICROMETRES_10
    assert found.neutral.annotations is None  # they name vertices that may be numbered otherwise now


def test_an_animation_carries_the_matched_weights(tmp_path: Path) -> None:
    rig, take = sheet_rig(), sheet_take()
    match = save_animation(rig, take, tmp_path / "take.glb")
    assert match.driven == ("jawOpen", "mouthSmileLeft")
    assert match.missing == ("eyeBlinkRight",)
    assert match.unused == ("tongueOut",)
    root, data = unpacked(tmp_path / "take.glb")

    def values(index: int) -> np.ndarray:
        accessor = root["accessors"][index]
        offset = root["bufferViews"][accessor["bufferView"]]["byteOffset"]
        return np.frombuffer(data, "<f4", accessor["count"], offset)

    sampler = root["animations"][0]["samplers"][0]
    assert sampler["interpolation"] == "LINEAR"
    assert np.allclose(values(sampler["input"]), np.arange(5) / 60)
    keys = values(sampler["output"]).reshape(5, 3)
    source = take.weights.values[..., 0].numpy()
    assert np.allclose(keys, np.stack([source[:, 2], source[:, 0], np.zeros(5)], axis=1))
    assert load_rig(tmp_path / "take.glb").names == rig.names


def test_an_animation_that_moves_nothing_is_refused(tmp_path: Path) -> None:
    rig = sheet_rig()
    strangers = Take(30.0, weights=Track(("AU12", "AU6"), torch.zeros(2, 2, 1)))
    with pytest.raises(NameMismatchError, match=r"none of its 2 channels \(AU12, AU6.*3 shapes \(jawOpen"):
        save_animation(rig, strangers, tmp_path / "take.glb")
    with pytest.raises(ValueRangeError, match="found no weights, expected weights"):
        save_animation(rig, Take(30.0), tmp_path / "take.glb")
    broken = Take(30.0, weights=Track(("jawOpen",), torch.tensor([[[0.0]], [[float("nan")]]])))
    with pytest.raises(ValueRangeError, match="NaN in the weights of 1 frames, first 1"):
        save_animation(rig, broken, tmp_path / "take.glb")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_behind_when_writing_fails(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="cannot be written"):
        save_rig(sheet_rig(), tmp_path / "nowhere" / "rig.glb")
    empty = Mesh(torch.zeros(3, 3), torch.zeros(0, 3, dtype=torch.int64))
    with pytest.raises(TopologyError, match="no triangle"):
        save_mesh(empty, tmp_path / "empty.glb")
    assert list(tmp_path.iterdir()) == []
