"""ARKit's shapes on real heads: ICT-FaceKit's, whose own shapes are the truth, stripped."""

from pathlib import Path

import pytest
import torch
import trimesh

from torchface import Annotations, BlendshapeRig, Mesh, save_rig
from torchface.errors import AlignmentError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.io import load_ict_facekit
from torchface.modeling import shapes_on
from torchface.modeling.rigging.mouth_parts import tongue_out
from torchface.synthetic import performer
from torchface.workflows.arkit import arkit_rig
from torchface.workflows.arkit.arkit_rig import Source, head_of, make_arkit


@pytest.mark.real
@pytest.mark.bench
def test_shapes_on_ict_go_the_way_of_its_own(ict_folder: Path) -> None:
    """Two sculptors' shapes differ; those of jaw, lids and smile go the same way, and nothing is renumbered."""
    rig = load_ict_facekit(ict_folder).with_arkit_names()
    made = make_arkit(Source(ict_folder, rig.neutral, rig), everything=True)
    assert len(made.made) == 52
    assert torch.equal(made.rig.neutral.faces, rig.neutral.faces)
    face = rig.neutral.annotations.regions["face"]
    names = [name for name in made.made if name in rig.names]
    own, truth = (one.deltas[one.index(names)][:, face].flatten(1) for one in (made.rig, rig))
    cosine = dict(zip(names, ((own * truth).sum(1) / (own.norm(dim=1) * truth.norm(dim=1))).tolist(), strict=True))
    assert float(torch.tensor(list(cosine.values())).median()) > 0.75
    for name, least in (("jawOpen", 0.88), ("eyeBlinkLeft", 0.75), ("mouthSmileRight", 0.7), ("mouthPucker", 0.8)):
        assert cosine[name] > least, (name, cosine[name])
    teeth = rig.neutral.annotations.regions["teeth"]
    opened = made.rig.deltas[made.rig.index(["jawOpen"])[0]][teeth].norm(dim=1)
    upper, lower = opened < 0.5, opened > 10
    assert bool((upper | lower).all())
    assert float(lower.double().mean()) == pytest.approx(0.5, abs=0.1)


@pytest.mark.real
@pytest.mark.bench
def test_a_turned_head_of_another_size_without_landmarks_is_found_by_its_looks(ict_folder: Path) -> None:
    rig = load_ict_facekit(ict_folder).with_arkit_names()
    turn = rotation_matrix(torch.tensor([[0.3, 2.0, 0.2]]))[0]
    bare = Mesh(0.5 * rig.vertices @ turn.T + 300, rig.neutral.faces)
    made = make_arkit(Source(Path("turned"), bare), everything=True)
    assert made.carried.registration.record.start == "landmarks"
    row = made.rig.index(["jawOpen"])[0]
    own, truth = 2 * made.rig.deltas[row] @ turn, rig.deltas[rig.index(["jawOpen"])[0]]
    face = rig.neutral.annotations.regions["face"]
    cosine = (own[face] * truth[face]).sum() / (own[face].norm() * truth[face].norm())
    assert float(cosine) > 0.85


def test_a_template_without_arkits_shapes_and_a_head_that_is_none_are_refused(tmp_path: Path) -> None:
    actor = performer(texture=False).select(["jawOpen"])
    save_rig(BlendshapeRig(actor.neutral, actor.deltas, ["Ears_Wiggle"]), tmp_path / "other.glb")
    source = Source(Path("head"), actor.neutral)
    with pytest.raises(ValueRangeError, match="found no shape of ARKit's names"):
        make_arkit(source, tmp_path / "other.glb")
    marks = actor.neutral.landmarks
    crumpled = actor.vertices.clone()
    crumpled[:, 2] = 5 * torch.sin(0.2 * crumpled[:, 0]) * torch.cos(0.2 * crumpled[:, 1])
    with pytest.raises(AlignmentError, match=r"--landmarks FILE"):
        make_arkit(Source(Path("crumpled"), actor.neutral.with_vertices(crumpled)))
    assert len(marks) == 68


def test_a_tongue_of_its_own_goes_with_the_jaw_and_comes_out() -> None:
    """A tongue is put into the performer's mouth: the tip comes before the lips, the root stays."""
    actor = performer(texture=False).select(["jawOpen"])
    lips = actor.vertices[actor.neutral.landmarks[60:]].mean(0)
    ball = trimesh.creation.icosphere(3)
    tongue = (
        torch.from_numpy(ball.vertices).float() * torch.tensor([11.0, 5.0, 22.0]) + lips - torch.tensor([0, 4.0, 32.0])
    )
    count = len(actor.vertices)
    faces = torch.cat([actor.neutral.faces, torch.from_numpy(ball.faces).long() + count])
    head = Mesh(torch.cat([actor.vertices, tongue]), faces, annotations=Annotations(actor.neutral.landmarks))
    carried = shapes_on(actor, head, (actor.neutral.landmarks, head.vertices[head.landmarks].double()))
    own = torch.arange(len(head.vertices)) >= count
    assert torch.equal(carried.tongue > 0, own)
    opened = carried.rig.deltas[0][own]
    assert torch.allclose(torch.pdist(tongue[::9] + opened[::9]), torch.pdist(tongue[::9]), atol=0.1)
    assert float(opened[:, 1].mean()) < -5
    out = tongue_out(head.vertices, own, head.vertices[head.landmarks[48:]])
    moved = tongue + out[own]
    assert float(moved[:, 2].max() - head.vertices[head.landmarks[48:], 2].max()) == pytest.approx(12.0, abs=0.5)
    assert float(out[~own].abs().max()) == 0
    assert float(out[own][tongue[:, 2].argmin()].norm()) < 1e-3


def bare(rig: BlendshapeRig, size: float) -> BlendshapeRig:
    """A rig of another size without landmarks and regions."""
    return BlendshapeRig(Mesh(size * rig.vertices, rig.neutral.faces), size * rig.deltas, rig.names)


def seen_as_they_are(rig: BlendshapeRig, size: float, patch: pytest.MonkeyPatch) -> None:
    marks = rig.neutral.landmarks[17:]
    places = size * rig.vertices[marks].double()
    patch.setattr(arkit_rig, "seen_landmarks", lambda head, template, progress: (marks, places))


@pytest.mark.bench
def test_the_unit_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    actor = performer(texture=False)
    seen_as_they_are(actor, 10.0, monkeypatch)
    made = make_arkit(Source(Path("large.glb"), bare(actor, 10.0).neutral))
    assert torch.equal(made.rig.vertices, 10.0 * actor.vertices)
    row, own = made.rig.index(["jawOpen"])[0], actor.deltas[actor.index(["jawOpen"])[0]]
    face = actor.neutral.annotations.regions["face"]
    assert float((made.rig.deltas[row] - 10 * own)[face].norm() / (10 * own)[face].norm()) < 0.05
    assert float(made.pose.scale[0]) == pytest.approx(10.0, rel=0.02)
    assert any(note.startswith("note: the head has 10 times the template's size") for note in made.notes)


def test_a_rig_that_has_all_shapes_gets_landmarks_and_regions(monkeypatch: pytest.MonkeyPatch) -> None:
    actor = performer(texture=False)
    whole = BlendshapeRig(actor.neutral, torch.cat([actor.deltas, actor.deltas[:1]]), (*actor.names, "tongueOut"))
    seen_as_they_are(actor, 2.5, monkeypatch)
    own = bare(whole, 2.5)
    made = make_arkit(Source(Path("all.glb"), own.neutral, own))
    assert (len(made.kept), made.made, made.carried) == (52, (), None)
    assert torch.equal(made.rig.vertices, own.vertices)
    assert torch.equal(made.rig.deltas[made.rig.index(["jawOpen"])[0]], own.deltas[own.index(["jawOpen"])[0]])
    apart = made.rig.vertices[made.rig.neutral.landmarks] - own.vertices[actor.neutral.landmarks]
    assert float(apart.norm(dim=1).median()) < 2.5  # a millimetre at a head's size
    regions = made.rig.neutral.annotations.regions
    known = actor.neutral.annotations.regions
    assert set(known) <= set(regions)
    assert float((regions["face"] == known["face"]).double().mean()) > 0.95


def test_another_unit_is_named_before_and_after_a_face_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(arkit_rig, "seen_landmarks", lambda *given: asked.append(given))
    large = bare(performer(texture=False), 1000.0).neutral
    with pytest.raises(ValueRangeError, match="say --unit mm"):
        make_arkit(Source(Path("head.obj"), large, unit="m"))
    small = bare(performer(texture=False), 0.1).neutral
    with pytest.raises(ValueRangeError, match="on the command line --unit cm"):
        make_arkit(Source(Path("head.obj"), small))
    assert not asked
    with pytest.raises(AlignmentError, match="no face is seen"):  # glTF is in metres; what is no head has no size
        make_arkit(Source(Path("ball.glb"), large))
    assert len(asked) == 1
    cube = trimesh.creation.box((150, 150, 150))
    block = Mesh(torch.from_numpy(cube.vertices).float(), torch.from_numpy(cube.faces).long())
    with pytest.raises(AlignmentError, match=r"cube\.glb: found 12 triangles, expected a head"):
        make_arkit(Source(Path("cube.glb"), block))


def test_of_a_whole_body_the_head_is_registered() -> None:
    actor = performer(texture=False).neutral
    below = torch.linspace(-1500, float(actor.vertices[:, 1].min()) - 10, 60)
    body = torch.stack([torch.zeros(60), below, torch.zeros(60)], 1)
    whole = Mesh(torch.cat([body, actor.vertices]), actor.faces + 60)
    head = head_of(whole)
    assert len(head.vertices) < len(whole.vertices)
    assert float(head.vertices[:, 1].max() - head.vertices[:, 1].min()) < 331
    assert head_of(actor) is actor
