"""A face in one piece gets a mouth that opens and eyes; what the file had keeps place, number and bytes."""

from pathlib import Path

import numpy as np
import pytest
import torch

from planted.characters import Planted, write_character
from planted.glb_files import unpacked
from torchface import BlendshapeRig, Mesh
from torchface.geometry.meshes.operators import border_edges
from torchface.geometry.similarity import Similarity
from torchface.io.gltf.character_scene import Character, read_character
from torchface.io.gltf.gltf_document import read_document
from torchface.landmarks.surfaces.face_on_surface import FaceOnSurface, FaceSearch
from torchface.rendering.raycast import RayCaster
from torchface.synthetic import performer
from torchface.workflows.rig.character_face import character_search
from torchface.workflows.rig.character_rig import CharacterReport, rig_character
from torchface.workflows.rig.face_openings import Loop, OpenedFace

AXIS, STEP = -15.0, 2.5  # millimetres: the axis round which the head is sampled, and how densely


def in_one_piece(rig: BlendshapeRig) -> Mesh:
    """The outer surface of a head: rays to an axis through it, without holes at mouth and eyes."""
    vertices = rig.vertices.double()
    caster = RayCaster(vertices, rig.neutral.faces)
    heights = torch.arange(-150.0, 105.0, STEP, dtype=torch.float64)
    around = torch.linspace(0, 2 * np.pi, int(2 * np.pi * 85 / STEP) + 1, dtype=torch.float64)[:-1]
    y, angle = torch.meshgrid(heights, around, indexing="ij")
    way = torch.stack([angle.sin(), 0 * y, angle.cos()], -1).reshape(-1, 3)
    foot = torch.stack([0 * y, y, 0 * y + AXIS], -1).reshape(-1, 3)
    far = 300 - caster.cast(foot + 300 * way, -way).distance
    far = torch.where(torch.isfinite(far), far, 20.0).clamp(min=5).view(y.shape)
    wide = torch.nn.functional.pad(far[None, None], (4, 4, 4, 4), mode="replicate")[0, 0]
    middle = wide.unfold(0, 9, 1).unfold(1, 9, 1).flatten(-2).median(-1).values
    far = torch.where((far - middle).abs() > 4, middle, far)  # between the lips rays go in
    ids = torch.arange(far.numel()).view(far.shape)
    quads = torch.stack([ids[:-1], ids.roll(-1, 1)[:-1], ids.roll(-1, 1)[1:], ids[1:]], -1).reshape(-1, 4)
    places = foot + far.reshape(-1, 1) * way
    return Mesh(places.float(), torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


@pytest.fixture(scope="module")
def rigged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, CharacterReport, Mesh]:
    folder = tmp_path_factory.mktemp("parts")
    head = in_one_piece(performer(texture=False))
    write_character(folder / "a.glb", head, how=Planted(body=False))
    with pytest.MonkeyPatch.context() as patch:
        known_face(patch)
        report = rig_character(folder / "a.glb", folder / "b.glb", inner_mouth=True, eyes=True)
    return folder / "a.glb", folder / "b.glb", report, head


def known_face(patch: pytest.MonkeyPatch) -> None:
    """Where the finder would find the face is known."""
    _, search = character_search()
    one = torch.ones(1, dtype=torch.float64)
    pose = Similarity(1e-3 * one, torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))
    found = FaceOnSurface(pose.apply(search.reference.all)[0], pose, 1.0, 0.0, (), torch.zeros(0, 3))
    patch.setattr(FaceSearch, "find", lambda *_: found)


def motion(character: Character, name: str) -> torch.Tensor:
    (block,) = character.blocks
    return 1000 * character.targets(block)[block.names.index(name)].double()


@pytest.mark.parametrize("inward", [False, True])
def test_the_upper_edge_of_a_hole_is_that_below_the_skin_above(inward: bool) -> None:
    """Of lips that cross at rest the upper one lies lower."""
    row, column = torch.arange(-6, 7), torch.arange(-8, 9)
    y, x = torch.meshgrid(5.0 * row, 5.0 * column, indexing="ij")
    rest = torch.stack([x, y, 0 * x], -1).reshape(-1, 3).double()
    ids = torch.arange(len(rest)).view(13, 17)
    quads = torch.stack([ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]], -1).reshape(-1, 4)
    middles = rest[quads].mean(1)
    quads = quads[(middles[:, 0].abs() > 20) | (middles[:, 1].abs() > 5)]
    faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    lips = [ids[one, 5:12] for one in (7, 5)]  # 5 mm above and below the line between them
    for lip, height in zip(lips, (-1.0, 1.0), strict=True):
        rest[lip, 1] = height
    way = torch.linspace(0, 2 * torch.pi, 25)[:-1].double()
    edge = torch.stack([20 * way.cos(), 3 * way.sin(), 0 * way], -1)
    loop = OpenedFace(rest, faces.flip(1) if inward else faces, torch.ones(len(rest), dtype=torch.bool)).hole(edge)
    upper = loop.vertices[(loop.share > 0) & (loop.share < 0.5)].tolist()
    assert set(lips[0].tolist()) <= set(upper)
    assert not set(lips[1].tolist()) & set(upper)


def test_the_upper_edge_of_lips_that_have_crossed_is_that_of_its_vertex() -> None:
    angle = torch.arange(12, dtype=torch.float64) * np.pi / 6
    places = torch.stack([angle.cos(), -0.01 * angle.sin(), 0 * angle], 1)  # the upper edge, 1 to 5, lies lower
    loop = Loop.of(torch.arange(12), places, top=3)
    assert loop.vertices.tolist() == list(range(12))
    assert loop.share[[0, 3, 6, 9]].tolist() == pytest.approx([0.0, 0.25, 0.5, 0.75])
    turned = Loop.of(torch.arange(12).flip(0), places, top=3)
    assert turned.vertices.tolist() == list(range(12))
    assert Loop.of(torch.arange(12), places).vertices.tolist() == [0, *range(11, 0, -1)]


@pytest.mark.bench
def test_old_vertices_and_bytes_stay(rigged: tuple[Path, Path, CharacterReport, Mesh]) -> None:
    before, after, report, head = rigged
    (_, old), (root, new) = unpacked(before), unpacked(after)
    assert new[: len(old)] == old
    assert len(root["meshes"][0]["primitives"]) == 2
    character = read_character(read_document(after))
    assert torch.equal(
        character.vertices[: len(head.vertices)].float(), read_character(read_document(before)).vertices.float()
    )
    assert set(report.made) >= {"tongueOut", "jawOpen"}
    text = "\n".join(report.lines())
    for word in ("behind lips that were cut apart", "added: teeth", "added: the left eye", "added: the right eye"):
        assert word in text
    assert "one piece" not in text


@pytest.mark.bench
def test_the_mouth_opens_and_no_tooth_stands_before_a_lip(rigged: tuple[Path, Path, CharacterReport, Mesh]) -> None:
    _, after, _, head = rigged
    character = read_character(read_document(after))
    (block,) = character.blocks
    skin = character.faces[: block.triangles[0]]
    rest = 1000 * character.vertices
    ahead = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    actor = performer(texture=False)
    middle = actor.vertices[actor.neutral.landmarks[[62, 66]]].double().mean(0)
    for name, depth in (("jawOpen", 12.0), ("", 0.0)):
        posed = rest + (motion(character, name) if name else 0.0)
        eye = middle + torch.tensor([[0.0, -8.0 if name else 1.5, 100.0]])
        front = float(RayCaster(posed, skin).cast(eye, ahead).distance)
        whole = float(RayCaster(posed, character.faces).cast(eye, ahead).distance)
        assert front > 100.0 + depth if name else whole == pytest.approx(front, abs=1e-3)
    assert not bool(border_edges(skin).all(1).any())
    out = motion(character, "tongueOut")
    assert float(out[len(head.vertices) :, 2].max()) > 20.0  # millimetres, toward the viewer


@pytest.mark.bench
def test_added_teeth_go_with_the_jaw_that_a_character_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By another program's name, and as far as its own chin goes: 0.6 of the template's."""
    known_face(monkeypatch)
    actor = performer(texture=False)
    jaw = 0.6 * actor.deltas[actor.names.index("jawOpen")]
    write_character(tmp_path / "a.glb", actor.neutral, {"A25_Jaw_Open": jaw}, Planted(body=False))
    report = rig_character(tmp_path / "a.glb", tmp_path / "b.glb", inner_mouth=True)
    assert "jawOpen" not in report.made
    character = read_character(read_document(tmp_path / "b.glb"))
    moved = motion(character, "A25_Jaw_Open")
    count = len(actor.vertices)
    torch.testing.assert_close(moved[:count].float(), jaw, atol=1e-3, rtol=0)
    far = moved[count:].norm(dim=1)
    chin = float(jaw[actor.neutral.landmarks[8]].norm())
    assert 0.6 * chin < float(far.max()) < 1.1 * chin  # the lower teeth and the tongue
    assert float((far < 0.5).double().mean()) > 0.3  # the upper ones
