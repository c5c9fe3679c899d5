"""Tests of shapes on another topology: the embedded performer's head with other vertices has the performer's shapes."""

from dataclasses import replace

import pytest
import torch

from torchface import Annotations, BlendshapeRig, Mesh
from torchface.errors import ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity
from torchface.modeling import CarriedShapes, shapes_on
from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.modeling.rigging.other_topology import TemplatePlaces
from torchface.synthetic import performer

SHAPES = ["eyeBlinkLeft", "eyeLookOutLeft", "jawOpen", "mouthSmileLeft", "mouthPucker", "browInnerUp"]
SCALE = 0.6  # the head is smaller, and turned
TURN = rotation_matrix(torch.tensor([[0.2, 0.5, -0.1]], dtype=torch.float64))[0]


@pytest.fixture(scope="module")
def template() -> BlendshapeRig:
    return performer(texture=False).select(SHAPES)


@pytest.fixture(scope="module")
def head(template: BlendshapeRig) -> tuple[Mesh, torch.Tensor]:
    """The same head with a vertex in the middle of each quad, in another order, and the deltas of its shapes."""
    quads = template.neutral.polygons
    quads = quads[(quads >= 0).all(1)]
    order = torch.randperm(len(template.vertices) + len(quads), generator=torch.Generator().manual_seed(0))
    count = len(template.vertices)
    middles = count + torch.arange(len(quads))
    faces = torch.cat([torch.stack([quads[:, k], quads[:, (k + 1) % 4], middles], 1) for k in range(4)])

    def reordered(values: torch.Tensor) -> torch.Tensor:
        return torch.cat([values, values[..., quads, :].mean(-2)], -2)[..., order, :]

    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    vertices = SCALE * reordered(template.vertices.double()) @ TURN.T
    deltas = SCALE * reordered(template.deltas.double()) @ TURN.T
    mesh = Mesh(vertices.float(), place[faces], annotations=Annotations(place[template.neutral.landmarks]))
    return mesh, deltas


@pytest.fixture(scope="module")
def carried(template: BlendshapeRig, head: tuple[Mesh, torch.Tensor]) -> CarriedShapes:
    mesh, _ = head
    return shapes_on(template, mesh, (template.neutral.landmarks, mesh.vertices[mesh.landmarks].double()))


def test_the_heads_vertices_stay_as_they_are(carried: CarriedShapes, head: tuple[Mesh, torch.Tensor]) -> None:
    assert carried.rig.neutral is head[0]
    assert carried.rig.names == tuple(SHAPES)


def test_every_shape_is_the_true_one(carried: CarriedShapes, head: tuple[Mesh, torch.Tensor]) -> None:
    truth, found = head[1].flatten(1), carried.rig.deltas.double().flatten(1)
    relative = (found - truth).norm(dim=1) / truth.norm(dim=1)
    cosine = (found * truth).sum(1) / (found.norm(dim=1) * truth.norm(dim=1))
    assert float(cosine.min()) > 0.985, dict(zip(SHAPES, cosine.tolist(), strict=True))
    assert float(relative.max()) < 0.18, dict(zip(SHAPES, relative.tolist(), strict=True))


def test_a_lip_that_lies_where_the_other_is_goes_with_its_own_jaw(
    carried: CarriedShapes, template: BlendshapeRig
) -> None:
    rig, one = template.select(["jawOpen"]), torch.ones(1, dtype=torch.float64)
    still = Similarity(one, torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))
    registration = replace(carried.registration, mesh=rig.neutral, pose=still)
    regions, line = rig.neutral.annotations.regions, rig.vertices[rig.neutral.landmarks[[62, 66]]].mean(0)
    middle = (rig.vertices[:, 0].abs() < 12) & (rig.vertices[:, 1] < line[1] + 0.5)
    rows = (regions["lower_lip"] & middle & ((rig.vertices - line)[:, 1] > -2)).nonzero()[:, 0]
    raised = rig.vertices.clone()
    raised[rows, 1] += 4.0  # among the upper lip's vertices
    target, truth = Mesh(raised, rig.neutral.faces), rig.deltas[0, rows].norm(dim=-1)
    guessed = shapes_on(rig, target, registration=registration).rig.deltas[0, rows].norm(dim=-1)
    told = shapes_on(rig, target, registration=registration, followed=TemplatePlaces.at(rows, rows))
    assert float((guessed / truth).min()) < 0.5
    assert float((told.rig.deltas[0, rows].norm(dim=-1) / truth - 1).abs().max()) < 0.1


def test_an_eyeball_turns_rigidly(
    carried: CarriedShapes, head: tuple[Mesh, torch.Tensor], template: BlendshapeRig
) -> None:
    mesh, truth = head
    look = SHAPES.index("eyeLookOutLeft")
    part = joined_vertices(mesh.vertices.double(), mesh.faces).part
    moving = truth[look].norm(dim=1) > 0.02
    ball = max((part == one for one in part[moving].unique()), key=lambda m: float(moving[m].double().mean()))
    rest = mesh.vertices[ball].double()
    posed = rest + carried.rig.deltas[look, ball].double()
    assert torch.allclose(torch.pdist(posed[::7]), torch.pdist(rest[::7]), atol=SCALE * 0.05)
    assert float((carried.rig.deltas[look, ball].double() - truth[look, ball]).norm(dim=1).max()) < SCALE * 0.5


def test_what_may_not_move_does_not(
    template: BlendshapeRig, head: tuple[Mesh, torch.Tensor], carried: CarriedShapes
) -> None:
    mesh, _ = head
    movable = torch.ones(len(mesh.vertices), dtype=torch.bool)
    movable[mesh.landmarks[48:]] = False
    fixed = shapes_on(template, mesh, registration=carried.registration, movable=movable)
    assert float(fixed.rig.deltas[:, ~movable].abs().max()) == 0.0
    assert torch.allclose(fixed.rig.deltas[:, movable], carried.rig.deltas[:, movable], atol=SCALE * 0.5)
    with pytest.raises(ValueRangeError, match="movable: found"):
        shapes_on(template, mesh, registration=carried.registration, movable=movable[:5])


@pytest.mark.parametrize("gap", [0.0, 0.03])
def test_vertices_split_at_a_seam_are_one_and_lips_that_touch_are_two(gap: float) -> None:
    """Two squares share an edge that is split, its halves apart or not; a third lies on one, facing the other way."""
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
    vertices = torch.cat([square, square + torch.tensor([1.0 + gap, 0, 0]), square])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7], [8, 10, 9], [8, 11, 10]])
    joined = joined_vertices(vertices, faces)
    assert len(joined.vertices) == 10
    assert joined.of[1] == joined.of[4]
    assert joined.of[2] == joined.of[7]
    assert joined.part[joined.of[0]] == joined.part[joined.of[5]] != joined.part[joined.of[8]]


@pytest.mark.parametrize(("triangles", "warned"), [(2, False), (3, True)])
def test_teeth_of_both_jaws_that_share_an_edge_are_warned_of(
    carried: CarriedShapes, triangles: int, warned: bool
) -> None:
    """An edge of the upper teeth with triangles to points of the lower ones, which go with the chin."""
    mesh, jaw = carried.rig.neutral, carried.rig.names.index("jawOpen")
    lips = carried.template.vertices[carried.template.neutral.landmarks[60:68]].double().mean(0)
    upper = torch.tensor([[-2.0, 1, -14], [2, 1, -14]]).double()
    lower = torch.tensor([[-2.0, -1, -14], [2, -1, -14], [0, -1, -12]]).double()
    vertices = carried.registration.pose.apply(lips + torch.cat([upper, lower]))[0].to(mesh.vertices)
    deltas = torch.zeros(len(SHAPES), 5, 3)
    deltas[jaw, 2:] = carried.rig.deltas[jaw, mesh.landmarks[8]]
    fan = len(mesh.vertices) + torch.tensor([[0, 1, 2], [0, 1, 3], [0, 1, 4]])[:triangles]
    joined = Mesh(torch.cat([mesh.vertices, vertices]), torch.cat([mesh.faces, fan]))
    rig = BlendshapeRig(joined, torch.cat([carried.rig.deltas, deltas.to(carried.rig.deltas)], 1), carried.rig.names)
    notes = replace(carried, rig=rig).notes()
    assert [f"{2 * triangles} edges inside the mouth join both jaws" in note for note in notes] == [True] * warned


def test_lips_in_one_piece_are_warned_of(carried: CarriedShapes) -> None:
    assert carried.notes() == []
    mesh, marks = carried.rig.neutral, carried.rig.neutral.landmarks
    upper, lower = marks[[61, 62, 63]], marks[[67, 66, 65]]
    between = torch.cat(
        [torch.stack([upper, lower, lower.roll(1)], 1), torch.stack([upper, lower.roll(1), upper.roll(1)], 1)]
    )
    welded = Mesh(mesh.vertices, torch.cat([mesh.faces, between]))
    rig = BlendshapeRig(welded, carried.rig.deltas, carried.rig.names)
    (note,) = replace(carried, rig=rig, open_lids=(0.0, 0.0)).notes()
    assert "lips are one piece" in note
    (note,) = replace(carried, open_lids=(0.4, 0.0)).notes()
    assert note == "warning: right eye: its blink leaves 40% of it open"


def test_folds_behind_the_upper_lip_that_are_drawn_out_are_no_lips_in_one_piece(carried: CarriedShapes) -> None:
    """A head with a muzzle: some of its upper lip's inside went with the jaw, while the mouth opened."""
    mesh, jaw = carried.rig.neutral, carried.rig.names.index("jawOpen")
    lips = carried.template.vertices[carried.template.neutral.landmarks[60:68]].double().mean(0)
    x = torch.tensor([-2.0, -1.0, 0.0, 1.0, 2.0, 3.0]).double()
    upper = torch.stack([x, torch.full_like(x, 6.0), torch.full_like(x, -2.0)], 1)
    own = torch.cat([upper, upper - torch.tensor([0.0, 1.5, 2.0])])
    vertices = carried.registration.pose.apply(lips + own)[0].to(mesh.vertices)
    deltas = torch.zeros(len(SHAPES), len(own), 3)
    deltas[jaw, len(upper) :] = 0.6 * carried.rig.deltas[jaw, mesh.landmarks[8]]
    row = len(mesh.vertices) + torch.arange(len(x) - 1)
    fold = torch.stack([row, row + 1, row + len(x)], 1)
    joined = Mesh(torch.cat([mesh.vertices, vertices]), torch.cat([mesh.faces, fold]))
    rig = BlendshapeRig(joined, torch.cat([carried.rig.deltas, deltas.to(carried.rig.deltas)], 1), carried.rig.names)
    assert not any("one piece" in note for note in replace(carried, rig=rig).notes())
