import json
import shutil
from pathlib import Path

import pytest
import torch
import trimesh
from mutation import check_reader
from rig_samples import quad_sheet

from torchface import BlendshapeRig, Mesh, load_rig, save_mesh
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TopologyError
from torchface.io import load_identity_modes

INDICES = {"expressions": ["jawOpen", "jawLeft"], "idx_to_landmark_verts": [3, 17, 0]}


def small_folder(folder: Path) -> Mesh:
    """A folder laid out as ICT's: a neutral, three expressions of which two are listed, two identity modes."""
    folder.mkdir(exist_ok=True)
    mesh = quad_sheet()
    bare = Mesh(mesh.vertices, mesh.faces, mesh.uvs, mesh.uv_faces, polygons=mesh.polygons)
    names = ("generic_neutral_mesh", "jawOpen", "jawLeft", "cheekRaiser_L", "identity000", "identity001")
    for step, name in enumerate(names):
        save_mesh(bare.with_vertices(bare.vertices + step * torch.tensor([1.0, 0, 0])), folder / f"{name}.obj")
    (folder / "vertex_indices.json").write_text(json.dumps(INDICES))
    return bare


@pytest.mark.real
def test_the_real_head_has_its_parts_shapes_landmarks_and_mirror(ict_folder: Path) -> None:
    rig = load_rig(ict_folder)
    mesh, notes = rig.neutral, rig.neutral.annotations
    listed = json.loads((ict_folder / "vertex_indices.json").read_text())
    assert list(rig.names) == listed["expressions"]
    assert len(rig.names) == 53
    assert mesh.vertices.shape == (26_719, 3)
    assert len(mesh.polygons) == 26_384
    assert int((mesh.polygons[:, 3] < 0).sum()) == 26_384 * 2 - len(mesh.faces)
    assert notes.landmarks.tolist() == listed["idx_to_landmark_verts"]
    assert notes.regions["face"].nonzero()[:, 0].tolist() == list(range(9409))
    parts = torch.stack([mask for name, mask in notes.regions.items() if name != "narrow_face"])
    assert len(parts) == 17
    assert (parts.sum(0) == 1).all()
    for left in (name for name in notes.regions if name.endswith("_left")):
        assert mesh.vertices[notes.regions[left], 0].mean() > 10
    # Outer eye corners of an adult lie some 90 mm apart: the unit is right.
    corners = mesh.vertices[mesh.landmarks[[36, 45]]]
    assert 80 < (corners[0] - corners[1]).norm() < 110
    twin = notes.mirror
    assert torch.equal(twin[twin], torch.arange(len(twin)))
    flipped = mesh.vertices * torch.tensor([-1.0, 1, 1])
    assert (flipped - mesh.vertices[twin]).norm(dim=1).max() < 0.5
    quads = {tuple(sorted(polygon)) for polygon in mesh.polygons.tolist()}
    images = [tuple(sorted(twin[[i for i in p if i >= 0]].tolist())) for p in mesh.polygons[::7].tolist()]
    held = [image in quads or (-1, *image) in quads for image in images]
    assert sum(held) > 0.999 * len(held)


@pytest.mark.bench
@pytest.mark.real
def test_a_real_shape_moves_as_another_reader_says(ict_folder: Path) -> None:
    rig = load_rig(ict_folder, shapes=["cheekRaiser_L", "jawOpen"])
    loaded = [
        trimesh.load(ict_folder / f"{name}.obj", process=False, maintain_order=True, split_object=False)
        for name in ("generic_neutral_mesh", "jawOpen")
    ]
    # The other reader splits vertices at seams: the surfaces are compared, corner by corner.
    geometry = [mesh.to_geometry() if isinstance(mesh, trimesh.Scene) else mesh for mesh in loaded]
    places = [torch.as_tensor(mesh.vertices) * 10 for mesh in geometry]
    for ours, theirs in ((rig.neutral.vertices, places[0]), (rig.neutral.vertices + rig.deltas[1], places[1])):
        assert torch.allclose(ours.double().amin(0), theirs.amin(0), atol=1e-4)
        assert torch.allclose(ours.double().amax(0), theirs.amax(0), atol=1e-4)
    assert rig.deltas[1].norm(dim=1).max() > 20


@pytest.mark.real
def test_the_real_face_part_and_a_random_head(ict_folder: Path) -> None:
    face = load_rig(ict_folder, part="face")
    assert face.neutral.vertices.shape == (9409, 3)
    assert len(face.neutral.polygons) == 9230
    modes = load_identity_modes(ict_folder, part="face")
    assert modes.deltas.shape == (20, 9409, 3)
    assert torch.equal(modes.neutral.vertices, face.neutral.vertices)
    heads = torch.stack([modes.random_head(seed).vertices for seed in range(40)])
    spread = (heads - modes.neutral.vertices).norm(dim=2).mean()
    assert 1 < spread < 20
    assert torch.equal(modes.random_head(3).vertices, heads[3])
    moved = BlendshapeRig(modes.random_head(0), face.deltas, face.names)
    assert moved.neutral.landmarks.tolist() == face.neutral.landmarks.tolist()


def test_expressions_are_those_listed_and_others_on_request(tmp_path: Path) -> None:
    mesh = small_folder(tmp_path / "ict")
    rig = load_rig(tmp_path / "ict")
    assert rig.names == ("jawOpen", "jawLeft")
    assert torch.allclose(rig.neutral.vertices, mesh.vertices * 10)
    assert torch.allclose(rig.deltas[1], torch.tensor([20.0, 0, 0]).expand(30, 3), atol=1e-4)
    assert rig.neutral.landmarks.tolist() == [3, 17, 0]
    assert torch.equal(rig.neutral.polygons, mesh.polygons)
    extra = load_rig(tmp_path / "ict", shapes=["cheekRaiser_L"], unit="mm")
    assert torch.allclose(extra.deltas[0], torch.tensor([3.0, 0, 0]).expand(30, 3), atol=1e-5)


def test_a_head_is_the_mean_and_its_modes(tmp_path: Path) -> None:
    small_folder(tmp_path / "ict")
    modes = load_identity_modes(tmp_path / "ict")
    assert modes.names == ("identity000", "identity001")
    head = modes.head(torch.tensor([0.5, -2.0]))
    expected = modes.neutral.vertices + torch.tensor([0.5 * 40 - 2 * 50.0, 0, 0])
    assert torch.allclose(head.vertices, expected, atol=1e-3)
    assert len(load_identity_modes(tmp_path / "ict", count=1).names) == 1
    with pytest.raises(ShapeError, match=r"coefficients: found \(3,\), expected \(2,\)"):
        modes.head(torch.zeros(3))
    with pytest.raises(NameMismatchError, match="found 2 identity modes, expected at least 100"):
        load_identity_modes(tmp_path / "ict", count=100)


def test_what_is_wrong_in_the_folder_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "ict"
    mesh = small_folder(folder)
    with pytest.raises(NameMismatchError, match=r"found no shape 'tongueOut'; its files are cheekRaiser_L"):
        load_rig(folder, shapes=["tongueOut"])
    with pytest.raises(NameMismatchError, match=r"no shape '../ict/jawOpen'"):
        load_rig(folder, shapes=["../ict/jawOpen"])
    text = (folder / "jawOpen.obj").read_text()
    (folder / "jawOpen.obj").write_text(text.replace("v ", "# ", 1))
    with pytest.raises(TopologyError, match=r"jawOpen.obj: found 29 vertices, expected the 30 of the neutral mesh"):
        load_rig(folder)
    save_mesh(Mesh(mesh.vertices, mesh.faces.flip(0)), folder / "jawOpen.obj")
    with pytest.raises(TopologyError, match=r"jawOpen.obj: found other faces than in the neutral"):
        load_rig(folder)
    (folder / "vertex_indices.json").write_text('{"expressions": "all"}')
    with pytest.raises(FileFormatError, match=r"vertex_indices.json: found expressions = 'all', expected a list"):
        load_rig(folder)
    (folder / "vertex_indices.json").write_text(json.dumps({**INDICES, "idx_to_landmark_verts": [30]}))
    with pytest.raises(FileFormatError, match="found landmark vertex 30, expected less than 30"):
        load_rig(folder)
    for path in folder.glob("identity*.obj"):
        path.unlink()
    (folder / "vertex_indices.json").write_text(json.dumps(INDICES))
    with pytest.raises(FileFormatError, match="found no identity mode"):
        load_identity_modes(folder)


def load_with_these_indices(path: Path) -> BlendshapeRig:
    """A small ICT folder whose ``vertex_indices.json`` is the file at ``path``."""
    folder = path.parent / "ict"
    if not folder.exists():
        small_folder(folder)
    shutil.copy(path, folder / "vertex_indices.json")
    return load_rig(folder)


def test_mutated_indices_are_read_or_refused(tmp_path: Path) -> None:
    (tmp_path / "good.json").write_text(json.dumps(INDICES))
    report = check_reader(load_with_these_indices, [tmp_path / "good.json"], ".json")
    assert report.refused > report.cases / 4


def test_the_repository_in_place_of_its_model_is_told(tmp_path: Path) -> None:
    (tmp_path / "FaceXModel").mkdir()
    for name in ("vertex_indices.json", "generic_neutral_mesh.obj"):
        (tmp_path / "FaceXModel" / name).write_text("{}")
    with pytest.raises(FileFormatError, match=r"found ICT-FaceKit's repository, expected .*FaceXModel"):
        load_identity_modes(tmp_path)
