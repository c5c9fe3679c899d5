"""A character gets ARKit's shapes on its face and comes back with all else as it was; what is none is refused."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from planted.characters import Planted, box_mesh, caricature, decimated, write_character
from planted.glb_files import packed, unpacked
from torchface import BlendshapeRig, Mesh, load_rig
from torchface.cli import main
from torchface.errors import AlignmentError, FileFormatError, ValueRangeError
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.io import save_mesh
from torchface.io.gltf.character_scene import Character, read_character
from torchface.io.gltf.gltf_document import read_document
from torchface.io.vrm.vrm_expressions import vrm_expressions
from torchface.landmarks.surfaces.face_on_surface import FaceOnSurface, FaceSearch, NoFaceOnSurfaceError
from torchface.shape_names import ARKIT
from torchface.synthetic import draw_identities, performer
from torchface.workflows.rig import character_face, character_rig
from torchface.workflows.rig.character_job import CharacterJob
from torchface.workflows.rig.character_rig import CharacterReport, check_character, rig_character
from torchface.workflows.rig.present_shapes import present_shapes

FEW = ((0.0, 4),)
TURN = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)  # lies on its back


@dataclass(frozen=True, eq=False)
class Rigged:
    before: Path
    after: Path
    report: CharacterReport
    own: BlendshapeRig
    character: Character


@pytest.fixture(scope="module")
def rigged(tmp_path_factory: pytest.TempPathFactory) -> Rigged:
    """A caricature with a body, in centimetres, on its back; a VRM that has a jaw and a blink under other names."""
    folder = tmp_path_factory.mktemp("character")
    person = performer(draw_identities(1, torch.Generator().manual_seed(3))[0], texture=False)
    own = caricature(person, person.vertices[person.neutral.landmarks])
    jaw, blink = (own.deltas[own.names.index(name)] for name in ("jawOpen", "eyeBlinkLeft"))
    how = Planted(turn=TURN, units=100.0, vrm="VRMC_vrm", expressions={"blinkLeft": "m_17"})
    write_character(folder / "a.vrm", own.neutral, {"A25_Jaw_Open": jaw, "m_17": blink, "fat": 0.1 * jaw}, how)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(character_face, "FaceSearch", partial(FaceSearch, rings=((0.0, 2), (90.0, 1), (-90.0, 1))))
        report = rig_character(folder / "a.vrm", folder / "b.vrm")
    return Rigged(folder / "a.vrm", folder / "b.vrm", report, own, read_character(read_document(folder / "b.vrm")))


@pytest.mark.bench
def test_all_else_of_the_file_is_as_it_was(rigged: Rigged) -> None:
    (before, old), (after, new) = unpacked(rigged.before), unpacked(rigged.after)
    assert new[: len(old)] == old
    for key in before:
        if key not in ("accessors", "bufferViews", "buffers", "meshes", "extensions", "animations"):
            assert after[key] == before[key], key
    for key in ("accessors", "bufferViews"):
        assert after[key][: len(before[key])] == before[key]
    assert after["meshes"][1:] == before["meshes"][1:]
    (mesh, was) = after["meshes"][0], before["meshes"][0]
    assert mesh["extras"]["targetNames"][:3] == was["extras"]["targetNames"]
    primitive, old_primitive = mesh["primitives"][0], was["primitives"][0]
    assert primitive["targets"][:3] == old_primitive["targets"]
    assert {**primitive, "targets": []} == {**old_primitive, "targets": []}
    vrm, old_vrm = after["extensions"]["VRMC_vrm"], before["extensions"]["VRMC_vrm"]
    assert {**vrm, "expressions": 0} == {**old_vrm, "expressions": 0}
    assert vrm["expressions"]["preset"] == old_vrm["expressions"]["preset"]


@pytest.mark.bench
def test_only_missing_shapes_are_made_and_the_vrm_has_expressions_for_all(rigged: Rigged) -> None:
    report = rigged.report
    assert report.present == {
        "eyeBlinkLeft": ("blinkLeft",),
        "jawOpen": ("A25_Jaw_Open",),
    }
    assert set(report.made) == set(ARKIT) - {"jawOpen", "eyeBlinkLeft", "tongueOut"}
    expressions = vrm_expressions(read_document(rigged.after))
    assert set(ARKIT) - {"tongueOut"} <= set(expressions)
    assert [bind.target for bind in expressions["jawOpen"]] == [0]
    assert [bind.target for bind in expressions["eyeBlinkLeft"]] == [1]
    assert expressions["eyeBlinkRight"][0].target == 3 + report.made.index("eyeBlinkRight")
    assert report.figure.is_file()
    assert any("a .glb's numbers are metres" in line for line in report.lines())


@pytest.mark.bench
def test_made_shapes_go_the_way_of_the_characters_own(rigged: Rigged) -> None:
    block = rigged.character.blocks[0]
    targets = rigged.character.targets(block).double() * 1000
    cosine = []
    for name in rigged.report.made:
        own = rigged.own.deltas[rigged.own.names.index(name)].double()
        found = targets[block.names.index(name), : len(own)]
        cosine.append(float((own * found).sum() / (own.norm() * found.norm())))
    assert float(np.median(cosine)) > 0.97
    assert min(cosine) > 0.75
    moved = targets[3:].norm(dim=-1).amax(0)
    assert float(moved[: len(rigged.own.vertices)].max()) > 5  # millimetres
    assert float(moved[len(rigged.own.vertices) :].max()) == 0  # the body


@pytest.mark.bench
def test_the_written_character_knows_its_landmarks(rigged: Rigged) -> None:
    made, person = load_rig(rigged.after), rigged.own
    notes = made.neutral.annotations
    eyes = made.vertices[notes.landmarks[[36, 45]]]
    truth = person.vertices[person.neutral.landmarks[[36, 45]]]
    assert float((eyes[0] - eyes[1]).norm()) == pytest.approx(100 * float((truth[0] - truth[1]).norm()), rel=0.01)
    jaw = made.deltas[made.names.index("A25_Jaw_Open")].norm(dim=1)
    own = person.deltas[person.names.index("jawOpen")].norm(dim=1)[person.neutral.landmarks]
    # Millimetres: those of the upper lip move by at most 17, of the lower by 33 at least.
    assert torch.allclose(jaw[notes.landmarks[48:]] / 100, own[48:], atol=4.0)
    assert {"eyeball_left", "eyeball_right", "face", "Body", "Hair"} <= set(notes.regions)


def test_a_chair_is_refused_with_a_picture_of_what_was_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(character_face, "FaceSearch", partial(FaceSearch, rings=FEW))
    seat, faces = box_mesh(torch.zeros(3), torch.tensor([400.0, 60.0, 400.0]))
    back, behind = box_mesh(torch.tensor([0.0, 250.0, -180.0]), torch.tensor([400.0, 440.0, 40.0]))
    chair = Mesh(torch.cat([seat, back]).float(), torch.cat([faces, behind + 8]))
    write_character(tmp_path / "chair.glb", chair, how=Planted(body=False))
    with pytest.raises(AlignmentError, match=r"found no face in 4 pictures.*out_face\.png"):
        rig_character(tmp_path / "chair.glb", tmp_path / "out.glb")
    assert (tmp_path / "out_face.png").is_file()
    assert not (tmp_path / "out.glb").exists()


@pytest.mark.parametrize(("met", "far", "refused"), [(0.42, 2.1, True), (0.84, 0.1, False)])
def test_a_ball_on_a_box_in_which_networks_see_a_face_is_refused_and_a_muzzle_is_not(
    met: float, far: float, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By figures that were measured on them."""
    template = performer(texture=False)
    share = torch.linspace(0, 1, len(template.vertices))
    region = template.neutral.annotations.regions["face"]
    share[region] = torch.linspace(0, 1, int(region.sum()))
    found = SimpleNamespace(matched=share < met, distance=torch.full_like(share, far))
    monkeypatch.setattr(character_rig, "register", lambda *_, **__: found)
    face = SimpleNamespace(skin=template.neutral, landmarks=None)
    if refused:
        with pytest.raises(AlignmentError, match=r"doll\.glb: the template lies 2\.1 mm .* meets 42% .*is it a face"):
            character_rig._registered(template, face, Path("doll.glb"), lambda *_: None)
    else:
        assert character_rig._registered(template, face, Path("doll.glb"), lambda *_: None) is found


def test_a_face_on_a_flat_card_is_refused_by_the_files_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    card = Mesh(
        torch.tensor([[-150.0, -150, 0], [150, -150, 0], [150, 150, 0], [-150, 150, 0]]),
        torch.tensor([[0, 1, 2], [0, 2, 3]]),
    )
    write_character(tmp_path / "card.glb", card, how=Planted(body=False))
    head = performer(texture=False).neutral
    at = head.vertices[head.landmarks].double() * torch.tensor([1.0, 1.0, 0.0])
    here = Similarity(torch.full((1,), 1e-3).double(), torch.eye(3).double()[None], torch.zeros(1, 3).double())
    found = FaceOnSurface(1e-3 * at, here, 1.0, 0.1, (torch.zeros(3, 8, 8),), torch.zeros(0, 3))
    monkeypatch.setattr(FaceSearch, "find", lambda *_: found)
    with pytest.raises(AlignmentError, match=r"card\.glb: found no face: .*of 2 triangles.*out_face\.png"):
        rig_character(tmp_path / "card.glb", tmp_path / "out.glb")
    assert (tmp_path / "out_face.png").is_file()


def test_a_head_of_too_many_triangles_is_refused_with_the_command_that_makes_it_coarser(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    head = performer(texture=False).neutral
    write_character(tmp_path / "fine.glb", head, how=Planted(body=False))
    _, search = character_face.character_search()
    here = Similarity(torch.full((1,), 1e-3).double(), torch.eye(3).double()[None], torch.zeros(1, 3).double())
    found = FaceOnSurface(here.apply(search.reference.all)[0], here, 1.0, 0.0, (), torch.zeros(0, 3))
    monkeypatch.setattr(FaceSearch, "find", lambda *_: found)
    monkeypatch.setattr(character_rig, "_MOST_TRIANGLES", 1000)
    with pytest.raises(ValueRangeError, match=r"fine\.glb: found [\d,]+ triangles on the head.*1,000.*simplify"):
        rig_character(tmp_path / "fine.glb", tmp_path / "out.glb")
    assert not (tmp_path / "out.glb").exists()


def test_files_that_are_no_characters_are_refused(tmp_path: Path) -> None:
    empty = tmp_path / "empty.glb"
    empty.write_bytes(packed({"asset": {"version": "2.0"}, "nodes": [{}], "scenes": [{"nodes": [0]}], "scene": 0}, b""))
    with pytest.raises(FileFormatError, match="no triangle"):
        rig_character(empty, tmp_path / "out.glb")
    with pytest.raises(
        FileFormatError, match=r"install Blender.*import_scene\.fbx\(filepath='.*hero\.fbx'\).*hero\.glb'"
    ):
        check_character(tmp_path / "hero.fbx")
    with pytest.raises(FileFormatError, match=r"found '\.jpg'.*torchface fit '.*my face\.jpg' --out 'my face\.glb'"):
        check_character(tmp_path / "my face.jpg")
    with pytest.raises(FileFormatError, match=r"expected.*\.glb"):
        rig_character(empty, tmp_path / "out.obj")
    with pytest.raises(FileFormatError, match="found a folder"):
        check_character(tmp_path)
    with pytest.raises(FileFormatError, match="no such file"):
        check_character(tmp_path / "hero.obj")
    (tmp_path / "my hero.obj").touch()
    with pytest.raises(FileFormatError, match=r"torchface arkit '.*my hero\.obj' --out 'my hero\.glb'"):
        check_character(tmp_path / "my hero.obj")
    for scale, unit in ((1.0, ""), (0.1, "--unit cm "), (0.001, "--unit m ")):
        head = performer(texture=False).neutral
        save_mesh(head.with_vertices(scale * head.vertices), tmp_path / "head.obj")
        with pytest.raises(FileFormatError, match=rf"gets ARKit's shapes by: torchface arkit .*head\.obj {unit}--out"):
            check_character(tmp_path / "head.obj")


def test_options_of_scans_are_refused_for_a_character(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "hero.glb").touch()
    with pytest.raises(SystemExit):
        main(["rig", str(tmp_path / "hero.glb"), "--unit", "cm", "--part", "face", "--out", str(tmp_path / "a.glb")])
    assert "found --part and --unit without --template" in " ".join(capsys.readouterr().err.split())


def test_a_character_that_has_all_shapes_is_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unseen(*_: object) -> None:
        raise NoFaceOnSurfaceError("found no face", ())

    monkeypatch.setattr(character_rig, "find_character_face", unseen)
    head = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
    names = [name.replace("Left", "_L").replace("Right", "_R") for name in ARKIT]
    how = Planted(vrm="VRMC_vrm", expressions={"blinkLeft": names[0]})
    write_character(tmp_path / "a.vrm", head, {name: torch.eye(3) for name in names}, how)
    report = rig_character(tmp_path / "a.vrm", tmp_path / "b.vrm")
    before, after = (read_character(read_document(tmp_path / name)) for name in ("a.vrm", "b.vrm"))
    assert after.blocks[0].names == ARKIT
    assert torch.equal(
        torch.as_tensor(after.targets(after.blocks[0])), torch.as_tensor(before.targets(before.blocks[0]))
    )
    assert set(vrm_expressions(read_document(tmp_path / "b.vrm"))) == {*ARKIT, "blinkLeft"}
    assert report.made == ()
    assert report.figure is None
    assert report.lines()[0] == report.verdict() == "result: good, 52 of ARKit's shapes were there, none is made"
    assert "already there: 52" in report.lines()[1]
    assert "nothing to make" in " ".join(report.lines())
    assert "no landmarks were added, which track --rig needs: found no face" in " ".join(report.lines())


def test_landmarks_are_added_to_a_character_that_has_all_shapes_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    person = performer(texture=False)
    shapes = dict(zip(person.names, person.deltas, strict=True)) | {"tongueOut": person.deltas[0]}
    write_character(tmp_path / "a.glb", person.neutral, shapes, Planted(turn=TURN, units=100.0))
    placed(monkeypatch, read_character(read_document(tmp_path / "a.glb")).vertices[: len(person.vertices)], person)
    report = rig_character(tmp_path / "a.glb", tmp_path / "b.glb")
    assert any(line.startswith("landmarks and regions added") for line in report.lines())
    given, made = load_rig(tmp_path / "a.glb"), load_rig(tmp_path / "b.glb")
    assert given.neutral.annotations.landmarks is None
    assert torch.equal(made.vertices, given.vertices)
    assert torch.equal(made.deltas, given.deltas)
    size = 100.0 * float(person.vertices[:, 0].max() - person.vertices[:, 0].min())
    body = made.neutral.annotations.regions["Body"].nonzero()[:, 0][0]
    truth = made.vertices[body + person.neutral.landmarks]
    apart = (made.vertices[made.neutral.landmarks] - truth).norm(dim=1)[17:]
    assert float(apart.max()) < 0.02 * size
    monkeypatch.setattr(character_rig, "find_character_face", lambda *_: pytest.fail("looks for a face"))
    rig_character(tmp_path / "b.glb", tmp_path / "c.glb")
    assert torch.equal(load_rig(tmp_path / "c.glb").neutral.landmarks, made.neutral.landmarks)


def placed(patch: pytest.MonkeyPatch, vertices: torch.Tensor, person: BlendshapeRig) -> None:
    """Lets the face of the embedded performer be found on a character whose first vertices are his."""
    _, search = character_face.character_search()
    pose = similarity_transform(person.vertices.double()[None], vertices[None])
    found = FaceOnSurface(pose.apply(search.reference.all)[0], pose, 1.0, 0.0, (), torch.zeros(0, 3))
    patch.setattr(FaceSearch, "find", lambda *_: found)


def test_few_triangles_and_shapes_that_move_far_are_warned_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    person = performer(texture=False).select(["jawOpen", "mouthPucker"])
    coarse = decimated(person, 1400)
    shapes = dict(zip(coarse.names, (40 * coarse.deltas[0], coarse.deltas[1]), strict=True))
    write_character(tmp_path / "a.glb", coarse.neutral, shapes, Planted(body=False))
    _, search = character_face.character_search()
    one = torch.ones(1, dtype=torch.float64)
    pose = Similarity(1e-3 * one, torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))
    found = FaceOnSurface(pose.apply(search.reference.all)[0], pose, 1.0, 0.0, (), torch.zeros(0, 3))
    monkeypatch.setattr(FaceSearch, "find", lambda *_: found)
    character = read_character(read_document(tmp_path / "a.glb"))
    face = character_face.find_character_face(character, character_face.textured(character))
    there, empty = present_shapes(character)
    record = SimpleNamespace(figures=str, remarks=())
    carried = SimpleNamespace(registration=SimpleNamespace(record=record))
    job = CharacterJob(character, face, carried, coarse, (), None, empty, (False, False))
    lines = job.notes(there, (), (0.0, 0.0))
    warnings = [line for line in lines if "warning" in line]
    assert len(warnings) == 2
    assert f"its skin has {len(face.skin.faces):,} triangles, expected 1,500" in warnings[0]
    moved = 40 * float(coarse.deltas[0].norm(dim=-1).max())
    assert f"its jawOpen moves by {moved:.3g} mm at a head's size" in warnings[1]


def test_draco_is_refused_with_the_command_that_decompresses(tmp_path: Path) -> None:
    path = tmp_path / "packed.glb"
    write_character(path, Mesh(torch.eye(3), torch.tensor([[0, 1, 2]])))
    root, binary = unpacked(path)
    root["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0}}
    path.write_bytes(packed(root, binary))
    with pytest.raises(FileFormatError, match="gltf-transform"):
        rig_character(path, tmp_path / "out.glb")
