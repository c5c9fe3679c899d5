"""Which heads are no neutral of a template: expressions, squeezed and lying heads; and people, who all are."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from planted.characters import caricature
from torchface import BlendshapeRig, Mesh, load_rig, save_mesh, save_rig
from torchface.cli import main
from torchface.errors import TopologyError
from torchface.geometry.similarity import similarity_transform
from torchface.io import load_ict_facekit, load_identity_modes
from torchface.modeling import neutral_notes
from torchface.modeling.rigging.neutral_check import pose_notes
from torchface.synthetic import draw_identities, neutral_head, performer

LYING = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def actor() -> BlendshapeRig:
    return performer(texture=False)


@pytest.fixture(scope="module")
def people() -> list[Mesh]:
    drawn = draw_identities(5, torch.Generator().manual_seed(3))
    return [neutral_head(one, texture=False) for one in drawn]


def shown(rig: BlendshapeRig, **weights: float) -> Tensor:
    """How far shapes move vertices, (V,3); a name without a side is both sides."""
    return sum(
        (weights[key] * rig.deltas[i] for i, name in enumerate(rig.names) for key in weights if name.startswith(key)),
        torch.zeros(len(rig.vertices), 3),
    )


def test_people_and_characters_at_rest_are_not_spoken_of(actor: BlendshapeRig, people: list[Mesh]) -> None:
    stylised = caricature(actor, actor.vertices[actor.neutral.landmarks], eyes=1.0)
    turned = people[0].with_vertices(0.8 * people[0].vertices + 40.0)
    for head in (actor.neutral, *people, stylised.neutral, turned):
        assert neutral_notes(actor, head) == ()


@pytest.mark.parametrize(
    "weights",
    [{"jawOpen": 0.6}, {"mouthSmile": 1.0}, {"eyeBlink": 1.0}, {"mouthPucker": 1.0}, {"browDown": 1.0}],
)
def test_an_expression_of_a_person_is_named(
    actor: BlendshapeRig, people: list[Mesh], weights: dict[str, float]
) -> None:
    (name,) = weights
    for head in people:
        (note,) = neutral_notes(actor, head.with_vertices(1.05 * (head.vertices + shown(actor, **weights)) + 7.0))
        assert f"differs from the template as {name}" in note
        assert " mm (" in note


@pytest.mark.usefixtures("coarse_figures")
def test_a_shape_that_is_found_can_be_taken_out(
    actor: BlendshapeRig, people: list[Mesh], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    template, head, out = tmp_path / "template.glb", tmp_path / "open.obj", tmp_path / "out.glb"
    save_rig(actor.select(["jawOpen", "mouthSmileLeft"]), template)
    jaw = shown(actor, jawOpen=0.7)
    save_mesh(people[0].with_vertices(people[0].vertices + jaw), head)
    main(["transfer", str(template), str(head), "--out", str(out), "--quiet"])
    said = " ".join(capsys.readouterr().err.split())
    assert "warning: the neutral is likely not at rest: it differs from the template as jawOpen=0." in said
    pose = said.split("--pose ")[1].split()[0]
    main(["rig", str(head), "--template", str(template), "--pose", pose, "--out", str(out), "--quiet"])
    assert "not at rest" not in capsys.readouterr().err
    rest = people[0].vertices.double()[None]
    made = load_rig(out).vertices.double()[None]
    left = similarity_transform(made, rest, scale=False).apply(made) - rest
    assert left.norm(dim=-1).max() < 0.15 * jaw.norm(dim=-1).max()


@pytest.mark.usefixtures("coarse_figures")
def test_a_pose_that_a_head_does_not_show_is_named(
    actor: BlendshapeRig, people: list[Mesh], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("jawOpen", "eyeBlinkLeft", "mouthSmileLeft"):
        given = torch.zeros(len(actor.names))
        given[actor.names.index(name)] = 1.0
        for head in people:
            (note,) = pose_notes(actor, head, given)
            assert f"shows nothing of {name}=1" in note
            there = head.with_vertices(head.vertices + shown(actor, **{name: 1.0}))
            assert pose_notes(actor, there, given) == pose_notes(actor, there, 0 * given) == ()
    save_rig(actor.select(["jawOpen", "mouthSmileLeft"]), tmp_path / "template.glb")
    save_mesh(people[0], tmp_path / "rest.obj")
    words = [tmp_path / "rest.obj", "--template", tmp_path / "template.glb", "--out", tmp_path / "out.glb"]
    main(["rig", *map(str, words), "--pose", "jawOpen=1", "--quiet"])
    assert "warning: the head shows nothing of jawOpen=1" in " ".join(capsys.readouterr().err.split())


def test_the_templates_own_expression_is_named_with_its_weights(actor: BlendshapeRig) -> None:
    smile = actor.neutral.with_vertices(actor.vertices + shown(actor, mouthSmile=1.0))
    (note,) = neutral_notes(actor, smile)
    assert "the template's own head in an expression" in note
    assert "--pose mouthSmileLeft=1.0 mouthSmileRight=1.0 takes" in note or "mouthSmileRight=1.0 mouthSmileLeft" in note


def test_a_shape_that_moves_one_vertex_is_named(actor: BlendshapeRig) -> None:
    deltas = torch.zeros(1, len(actor.vertices), 3)
    deltas[0, actor.neutral.landmarks[8], 1] = -20.0
    template = BlendshapeRig(actor.neutral, deltas, ("jawOpen",))
    (note,) = neutral_notes(template, actor.neutral.with_vertices(actor.vertices + deltas[0]))
    assert "jawOpen=1.0" in note


def test_shapes_that_make_another_person_are_no_expressions(actor: BlendshapeRig) -> None:
    vertices, tip = actor.vertices, actor.vertices[actor.vertices[:, 2].argmax()]
    away = (vertices - tip).norm(dim=1, keepdim=True)
    nose = torch.tensor([0.0, -2.0, 9.0]) * torch.exp(-((away / 14) ** 2))
    wide = (vertices - vertices.mean(0)) * torch.tensor([0.12, 0.0, 0.0])
    deltas = torch.cat([actor.deltas, nose[None], wide[None]])
    template = BlendshapeRig(actor.neutral, deltas, (*actor.names, "identityNoseBig", "identityWide"))
    for person in (vertices + 0.7 * nose, vertices + 0.8 * wide, vertices + nose + wide):
        assert neutral_notes(template, actor.neutral.with_vertices(person)) == ()
        (note,) = neutral_notes(template, actor.neutral.with_vertices(person + shown(actor, jawOpen=0.7)))
        assert "--pose jawOpen=0." in note


def test_a_wider_head_is_no_expression_of_a_template_without_arkits_names(actor: BlendshapeRig) -> None:
    fat = (actor.vertices - actor.vertices.mean(0)) * torch.tensor([0.15, 0.0, 0.1])
    smile = actor.deltas[[actor.names.index("mouthSmileLeft")]] + actor.deltas[[actor.names.index("mouthSmileRight")]]
    template = BlendshapeRig(actor.neutral, torch.cat([0 * smile, fat[None], smile]), ("Basis", "plump", "happy"))
    assert neutral_notes(template, actor.neutral.with_vertices(actor.vertices + fat)) == ()
    (note,) = neutral_notes(template, actor.neutral.with_vertices(actor.vertices + fat + smile[0]))
    assert "happy=" in note
    assert "plump" not in note


def test_a_template_without_shapes_shows_no_expression(actor: BlendshapeRig, people: list[Mesh]) -> None:
    assert neutral_notes(actor.select([]), people[0]) == ()


@pytest.mark.parametrize(("axis", "word"), [(0, "as wide"), (1, "as high"), (2, "as deep")])
def test_a_squeezed_head_is_named_with_its_proportions(
    actor: BlendshapeRig, people: list[Mesh], axis: int, word: str
) -> None:
    scale = torch.ones(3).index_fill(0, torch.tensor(axis), 1.5)
    for head in people:
        (note,) = neutral_notes(actor, head.with_vertices(head.vertices * scale))
        before = note.split(f" {word}")[0].removesuffix(" times").split()[-1]
        assert 1.25 < float(before) < 1.75


def test_a_lying_head_is_named_with_its_angle(actor: BlendshapeRig, people: list[Mesh]) -> None:
    (note,) = neutral_notes(actor, people[0].with_vertices(people[0].vertices @ LYING.T))
    assert "turned by 9" in note or "turned by 8" in note
    with pytest.raises(TopologyError, match="found 3 vertices"):
        neutral_notes(actor, Mesh(torch.rand(3, 3), torch.tensor([[0, 1, 2]])))


@pytest.mark.real
def test_icts_people_at_rest_are_not_spoken_of_and_their_smiles_are(ict_folder: Path) -> None:
    rig = load_ict_facekit(ict_folder, part="narrow_face")
    modes = load_identity_modes(ict_folder, part="narrow_face").deltas
    drawn = torch.randn(10, len(modes), generator=torch.Generator().manual_seed(2))
    smile = shown(rig, mouthSmile=0.8)
    for weights in drawn:
        person = rig.vertices + torch.tensordot(weights, modes, 1)
        assert neutral_notes(rig, rig.neutral.with_vertices(person)) == ()
        (note,) = neutral_notes(rig, rig.neutral.with_vertices(person + smile))
        assert "as mouthSmile_" in note
