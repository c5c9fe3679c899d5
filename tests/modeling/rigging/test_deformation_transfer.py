"""Deformation transfer on small rigs whose answers are known, and on a real head."""

import warnings
from pathlib import Path

import pytest
import torch
from torch import Tensor

from planted.characters import caricature
from torchface import BlendshapeRig, Corrective, Correctives, Mesh
from torchface.errors import AlignmentError, TopologyError, ValueRangeError
from torchface.geometry.meshes.operators import components
from torchface.io import load_ict_facekit, load_identity_modes
from torchface.modeling import rig_from_examples, transfer_deformation, transfer_with_report
from torchface.registration.own_topology import check_own_topology
from torchface.synthetic import draw_identities, neutral_head, performer

SHELLS = ("lacrimal_fluid", "eye_blend", "eye_occlusion")


def grid(columns: int, rows: int) -> Tensor:
    """Triangles of a grid of vertices, row by row."""
    corner = (torch.arange(rows - 1)[:, None] * columns + torch.arange(columns - 1)).flatten()
    upper = torch.stack([corner, corner + 1, corner + columns + 1], dim=1)
    lower = torch.stack([corner, corner + columns + 1, corner + columns], dim=1)
    return torch.cat([upper, lower])


def bump(at: Tensor, centre: tuple[float, float], width: float) -> Tensor:
    """1 at the centre, 0 from ``width`` on, smooth."""
    near = (1 - (at[:, :2] - torch.tensor(centre)).square().sum(-1) / width**2).clamp(min=0)
    return (near**2)[:, None]


def hill(depth: float = 20.0, columns: int = 25) -> Tensor:
    """A face-sized height field (V,3), float64."""
    axis = torch.linspace(-60, 60, columns, dtype=torch.float64)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    z = depth * torch.cos(x / 40) * torch.cos(y / 50) + 2 * torch.sin(x / 9) * torch.cos(y / 11)
    return torch.stack([x, y, z], dim=-1).view(-1, 3)


def hill_rig(columns: int = 25) -> BlendshapeRig:
    """Three shapes: a push outward, a slide, a turn about the line of sight."""
    at = hill(columns=columns)
    out = bump(at, (-20.0, 10.0), 30) * torch.tensor([0.0, 1.0, 6.0])
    slide = bump(at, (20.0, -15.0), 35) * torch.tensor([5.0, -2.0, 0.0])
    turn = bump(at, (10.0, 20.0), 30) * torch.stack([-at[:, 1], at[:, 0], 0 * at[:, 0]], dim=-1) * 0.2
    deltas = torch.stack([out, slide, turn]).double()
    return BlendshapeRig(Mesh(at, grid(columns, columns)), deltas, ["bulge", "slip", "twist"])


def other_face(rig: BlendshapeRig, depth: float = 30.0) -> Mesh:
    stretch = torch.tensor([1.1, 0.95, 1.0], dtype=torch.float64)
    return rig.neutral.with_vertices(hill(depth, int(len(rig.vertices) ** 0.5)) * stretch)


def rotation(degrees: float = 50.0) -> Tensor:
    axis = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64), dim=0)
    cross = torch.linalg.cross(axis.expand(3, 3), torch.eye(3, dtype=torch.float64)).T
    return torch.linalg.matrix_exp(torch.deg2rad(torch.tensor(degrees)) * cross)


def farthest(a: Tensor, b: Tensor) -> float:
    return float((a - b).norm(dim=-1).max())


def test_a_rig_onto_its_own_neutral_returns_itself() -> None:
    rig = hill_rig()
    result = transfer_deformation(rig, rig.neutral)
    assert farthest(result.deltas, rig.deltas) < 1e-6
    assert result.names == rig.names


def test_a_turned_scaled_moved_target_has_turned_scaled_shapes() -> None:
    rig, turn = hill_rig(), rotation()
    for mesh in (rig.neutral, other_face(rig)):
        straight = transfer_deformation(rig, mesh).deltas
        moved = mesh.with_vertices(1.3 * mesh.vertices @ turn.T + torch.tensor([40.0, -300.0, 900.0]))
        assert farthest(transfer_deformation(rig, moved).deltas, 1.3 * straight @ turn.T) < 1e-5


def test_what_is_still_in_the_source_is_still_in_the_result() -> None:
    rig = hill_rig()
    result = transfer_deformation(rig, other_face(rig))
    still = rig.deltas.norm(dim=-1) < 0.01
    assert still.any(1).all()
    assert float(result.deltas.norm(dim=-1)[still].max()) < 0.02


def test_a_face_that_is_not_the_neutral_is_refused_and_a_caricature_is_not() -> None:
    actor = performer(texture=False).select(["jawOpen"])
    rest = actor.vertices
    shuffled = rest.clone()
    some = torch.randperm(len(rest), generator=torch.Generator().manual_seed(0))[: len(rest) // 4]
    shuffled[some] = rest[some.roll(1)]
    for found, error, told in (
        (0.1 * rest, ValueRangeError, "in centimetres .*--unit cm"),
        (rest * torch.tensor([-1.0, 1.0, 1.0]), AlignmentError, "mirror image of the template.*right-handed"),
        (shuffled, AlignmentError, r"4\d\.\d % of its edges more than 5 times as long .* another order than"),
    ):
        with pytest.raises(error, match=told):
            transfer_deformation(actor, actor.neutral.with_vertices(found))
    far = torch.where(rest[:, 2:] > rest[:, 2].median(), 2.0, 1.0)  # the nose, the lips and the brow twice as far out
    caricature = rest * torch.tensor([3.0, 1.5, 1.0]) * far
    assert transfer_deformation(actor, actor.neutral.with_vertices(caricature)).deltas.isfinite().all()


@pytest.mark.parametrize(  # each part twice or more everyday, each shift too
    ("which", "shift"),
    [
        pytest.param(which, shift, marks=() if (i + j) % 2 == 0 else pytest.mark.bench)
        for i, which in enumerate(("all", "first half", "second half", "second quarter", "an eighth"))
        for j, shift in enumerate((1, -1, 2, 40))
    ],
)
def test_vertices_that_are_shifted_are_refused_in_a_person_and_in_a_stylised_head(which: str, shift: int) -> None:
    actor = performer(texture=False).select(["jawOpen"])
    count = len(actor.vertices)
    first, last = {
        "all": (0, count),
        "first half": (0, count // 2),
        "second half": (count // 2, count),
        "second quarter": (count // 4, count // 2),
        "an eighth": (5 * count // 8, 6 * count // 8),
    }[which]
    person = neutral_head(draw_identities(1, torch.Generator().manual_seed(0))[0], texture=False).vertices
    stylised = caricature(actor, actor.vertices[actor.neutral.landmarks], eyes=1.0).vertices
    for head in (actor.vertices, person, stylised):
        check_own_topology(actor.neutral, actor.neutral.with_vertices(head))
        shifted = head.clone()
        shifted[first:last] = head[first:last].roll(shift, 0)
        named = abs(shift) if abs(shift) < 4 else r"\d+"
        with pytest.raises(AlignmentError, match=rf"in another order .* are \d+ % .* a shift of {named} taken back"):
            check_own_topology(actor.neutral, actor.neutral.with_vertices(shifted))


def test_heads_of_torn_pieces_and_four_times_as_unlike_as_people_are_not_taken_for_shifted() -> None:
    actor = performer(texture=False)
    rest = actor.vertices
    generator = torch.Generator().manual_seed(0)
    heads = [rest + 4 * (neutral_head(one, texture=False).vertices - rest) for one in draw_identities(3, generator)]
    centre = rest[rest[:, 2].argmax()]
    for radius in (15.0, 30.0, 60.0):
        piece = (rest - centre - torch.tensor([0.0, -35.0, -10.0])).norm(dim=-1, keepdim=True) < radius
        heads.append(rest + 40.0 * piece)
        near = (rest - centre).norm(dim=-1, keepdim=True) < radius
        heads.append(torch.where(near, centre + 6 * (rest - centre), rest))
    for head in heads:
        check_own_topology(actor.neutral, actor.neutral.with_vertices(head))


def test_a_longer_jaw_swings_further() -> None:
    """A flap that turns about a line by 20 degrees does so on a target whose flap is longer: an exact answer."""
    axis = torch.linspace(-40, 40, 17, dtype=torch.float64)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    at = torch.stack([x, y, 0 * x], dim=-1).view(-1, 3)
    angle = torch.deg2rad(torch.tensor(20.0, dtype=torch.float64))

    def swing(points: Tensor) -> Tensor:
        flap = points[:, 1].clamp(max=0)
        return torch.stack([0 * flap, flap * (angle.cos() - 1), flap * angle.sin()], dim=-1)

    rig = BlendshapeRig(Mesh(at, grid(17, 17)), swing(at)[None], ["jaw"])
    longer = at * torch.where(at[:, 1:2] < 0, torch.tensor([1.0, 1.5, 1.0]), torch.ones(3))
    result = transfer_deformation(rig, rig.neutral.with_vertices(longer))
    assert farthest(result.deltas[0], swing(longer)) < 1e-5
    assert farthest(rig.deltas[0], swing(longer)) > 5


def test_shapes_that_move_the_same_vertices_are_solved_together_and_alike() -> None:
    rig = hill_rig()
    twice = BlendshapeRig(rig.neutral, torch.cat([rig.deltas, 0.5 * rig.deltas]), [*"abcdef"])
    counts: list[tuple[int, int]] = []
    together = transfer_deformation(
        twice, other_face(rig), progress=lambda _, done, total: counts.append((done, total))
    )
    assert counts[-1] == (6, 6)
    assert farthest(together.deltas[:3], transfer_deformation(rig, other_face(rig)).deltas) < 1e-6


def with_parts(rig: BlendshapeRig) -> tuple[BlendshapeRig, Tensor]:
    """The rig with a small patch that moves with the bulge, and one vertex of no triangle that does too."""
    patch = torch.tensor([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [4, 4, 1]], dtype=torch.float64)
    summit = int(rig.deltas[0].norm(dim=-1).argmax())
    extra = torch.cat([patch, patch[:1] + 2]) + rig.vertices[summit] + torch.tensor([0.0, 0, 3])
    nearest = torch.cdist(extra, rig.vertices).argmin(1)
    # The patch keeps to the summit alone, so that it moves rigidly.
    deltas = torch.cat([rig.deltas, rig.deltas[:, [summit]].expand(-1, 5, -1)], dim=1)
    deltas[:, -1] = rig.deltas[:, nearest[-1]]
    faces = torch.cat([rig.neutral.faces, torch.tensor([[0, 1, 2], [1, 3, 2]]) + len(rig.vertices)])
    return BlendshapeRig(Mesh(torch.cat([rig.vertices, extra]), faces), deltas, rig.names), nearest


def test_parts_and_loose_vertices_keep_their_offset_to_the_face() -> None:
    rig, nearest = with_parts(hill_rig())
    assert int(components(rig.neutral.faces, len(rig.vertices)).max()) == 2
    face = other_face(hill_rig()).vertices
    count = len(face)
    target = rig.neutral.with_vertices(torch.cat([face, rig.vertices[count:] + torch.tensor([1.0, 2.0, 6.0])]))
    result = transfer_deformation(rig, target)
    offset = rig.deltas[0, count:] - rig.deltas[0, nearest]
    kept = offset.norm(dim=-1) < 0.01
    assert int(kept.sum()) >= 2
    moved = result.deltas[0, count:] - result.deltas[0, nearest]
    assert float(moved[kept].norm(dim=-1).max()) < 0.1
    assert farthest(transfer_deformation(rig, rig.neutral).deltas, rig.deltas) < 1e-6


def test_triangles_without_area_are_survived_and_reported() -> None:
    rig = hill_rig()
    vertices, deltas = rig.vertices.clone(), rig.deltas.clone()
    a, b, c = rig.neutral.faces[300].tolist()
    vertices[c] = 0.5 * (vertices[a] + vertices[b])
    d, e, f = rig.neutral.faces[150].tolist()
    deltas[0, [d, e, f]] = vertices.mean(0) - vertices[[d, e, f]]
    broken = BlendshapeRig(rig.neutral.with_vertices(vertices), deltas, rig.names)
    report = transfer_with_report(broken, other_face(rig)).report
    assert 300 in report.flat_source
    assert 150 in report.flat_shapes["bulge"]
    assert len(report.flat_target) == 0
    with warnings.catch_warnings():  # what the template has is said by `torchface info`, not at each use
        warnings.simplefilter("error")
        result = transfer_deformation(broken, broken.neutral)
    assert farthest(result.deltas, deltas) < 1e-3
    flat_target = other_face(rig).vertices.clone()
    flat_target[c] = 0.5 * (flat_target[a] + flat_target[b])
    with pytest.warns(UserWarning, match="without area in the target: 1$"):
        result = transfer_deformation(rig, rig.neutral.with_vertices(flat_target))
    assert float(result.deltas.norm(dim=-1).max()) < 2 * float(rig.deltas.norm(dim=-1).max())


def test_what_cannot_be_transferred_is_named() -> None:
    rig = hill_rig()
    with pytest.raises(TopologyError, match=r"found a target of 625 vertices.*expected the source's topology"):
        transfer_deformation(rig, Mesh(rig.vertices, rig.neutral.faces[:-1]))
    reordered = Mesh(rig.vertices.flip(0), 624 - rig.neutral.faces)
    with pytest.raises(TopologyError, match=r"625 vertices and 1152 triangles, as many, which join other vertices"):
        transfer_deformation(rig, reordered)
    with pytest.raises(TopologyError, match="441"):
        transfer_deformation(rig, hill_rig(21).neutral)
    with pytest.raises(ValueRangeError, match="0 shapes"):
        transfer_deformation(BlendshapeRig(rig.neutral, rig.deltas[:0], []), rig.neutral)
    loose = Mesh(rig.vertices, torch.zeros(0, 3, dtype=torch.int64))
    with pytest.raises(TopologyError, match="no triangles"):
        transfer_deformation(BlendshapeRig(loose, rig.deltas, rig.names), loose)
    with pytest.raises(ValueRangeError, match="across"):
        transfer_deformation(rig, rig.neutral.with_vertices(torch.zeros_like(rig.vertices)))
    with pytest.raises(ValueRangeError, match="contact_weight"):
        transfer_deformation(rig, rig.neutral, contact_weight=-1.0)
    spoiled = rig.neutral.with_vertices(rig.vertices.clone())
    spoiled.vertices[3] = torch.nan
    with pytest.raises(ValueRangeError, match="target"):
        transfer_deformation(rig, spoiled)


@pytest.fixture(scope="module")
def real_rig(ict_folder: Path) -> BlendshapeRig:
    shapes = ["jawOpen", "mouthStretch_R", "eyeBlink_L", "mouthSmile_L"]
    return load_ict_facekit(ict_folder, shapes)


@pytest.mark.bench
@pytest.mark.real
def test_a_real_head_onto_itself_and_onto_a_turned_copy(real_rig: BlendshapeRig) -> None:
    itself = transfer_deformation(real_rig, real_rig.neutral)
    assert farthest(itself.deltas, real_rig.deltas) < 1e-3
    turn = rotation().float()
    turned = real_rig.neutral.with_vertices(1.3 * real_rig.vertices @ turn.T + 100)
    result = transfer_with_report(real_rig, turned).rig
    assert farthest(result.deltas, 1.3 * real_rig.deltas @ turn.T) < 1e-3


@pytest.mark.real
def test_teeth_eyes_and_lashes_of_a_random_head_keep_their_offset_to_the_face(
    real_rig: BlendshapeRig, ict_folder: Path
) -> None:
    target = load_identity_modes(ict_folder).random_head(3)
    result = transfer_with_report(real_rig, target).rig
    part = components(real_rig.neutral.faces, len(real_rig.vertices))
    assert int(part.max()) == 55
    # Shells of the eye give way to closing lids, see test_parts.py.
    notes = real_rig.neutral.annotations
    shells = torch.stack([mask for name, mask in notes.regions.items() if name.startswith(SHELLS)]).any(0)
    face, other = (part == 0).nonzero()[:, 0], ((part != 0) & ~shells).nonzero()[:, 0]
    nearest = face[torch.cdist(real_rig.vertices[other], real_rig.vertices[face]).argmin(1)]
    offset = (real_rig.deltas[:, other] - real_rig.deltas[:, nearest]).norm(dim=-1)
    moved = (result.deltas[:, other] - result.deltas[:, nearest]).norm(dim=-1)
    carried = (offset < 0.01) & (real_rig.deltas[:, nearest].norm(dim=-1) > 0.5)
    assert int(carried.sum()) > 100
    assert float(moved[offset < 0.01].max()) < 0.1
    still = real_rig.deltas.norm(dim=-1) < 0.01
    assert float(result.deltas.norm(dim=-1)[still].max()) < 0.02


@pytest.fixture(scope="module")
def corrective_rig() -> BlendshapeRig:
    linear = hill_rig()
    definitions = (
        Corrective("bulge_twist", ("bulge", "twist")),
        Corrective("all", ("bulge", "slip", "twist")),
        Corrective("slip_half", ("slip",), 0.5),
        Corrective("nothing", ("bulge", "slip")),
    )
    bulge, slip, twist = linear.deltas
    turned = twist.roll(1, 1)
    deltas = torch.stack([0.3 * turned, 0.2 * (bulge + slip).roll(1, 1), 0.4 * slip.roll(2, 1), 0 * slip])
    return BlendshapeRig(linear.neutral, linear.deltas, linear.names, Correctives(deltas, definitions))


def test_transferred_to_itself_a_rig_keeps_its_correctives(corrective_rig: BlendshapeRig) -> None:
    rig = corrective_rig
    found = transfer_deformation(rig, rig.neutral).correctives
    assert found.definitions == rig.correctives.definitions
    assert (found.deltas - rig.correctives.deltas).abs().max() < 1e-6


def test_correctives_turn_and_grow_with_the_face(corrective_rig: BlendshapeRig) -> None:
    rig = corrective_rig
    turn = rotation()
    target = rig.neutral.with_vertices(1.3 * rig.vertices @ turn.T + 7)
    found = transfer_deformation(rig, target).correctives
    assert (found.deltas - 1.3 * rig.correctives.deltas @ turn.T).abs().max() < 1e-6


def test_on_another_face_correctives_stay_where_they_were(corrective_rig: BlendshapeRig) -> None:
    rig = corrective_rig
    found = transfer_deformation(rig, other_face(rig)).correctives
    still = rig.correctives.deltas.norm(dim=-1) < 0.01
    assert found.deltas[still].norm(dim=-1).max() < 0.02
    assert found.deltas[3].abs().max() == 0.0
    changed = (found.deltas - rig.correctives.deltas).norm(dim=-1).amax(1)
    size = rig.correctives.deltas.norm(dim=-1).amax(1)
    assert (changed[:3] > 0.01 * size[:3]).all()
    assert (changed[:3] < 0.5 * size[:3]).all()


def test_examples_are_explained_by_shapes_and_correctives_together(corrective_rig: BlendshapeRig) -> None:
    rig = corrective_rig
    weights = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0.5, 0], [0.5, 0, 1], [1, 1, 1]], dtype=torch.float64)
    found = rig_from_examples(rig, rig.neutral, rig(weights), weights)
    assert (found.rig(weights) - rig(weights)).norm(dim=-1).max() < 0.05
    linear = rig_from_examples(rig.without_correctives(), rig.neutral, rig(weights), weights)
    far = (linear.rig(linear.weights) - rig(weights)).norm(dim=-1).max()
    assert far > 4 * (found.rig(found.weights) - rig(weights)).norm(dim=-1).max()


@pytest.fixture(scope="module")
def template() -> BlendshapeRig:
    return performer(texture=False)


@pytest.fixture(scope="module")
def others() -> list[BlendshapeRig]:
    return [performer(k, texture=False) for k in draw_identities(4, torch.Generator().manual_seed(0))]


@pytest.mark.bench
def test_transferred_shapes_are_nearer_to_the_truth_than_copied_ones(
    template: BlendshapeRig, others: list[BlendshapeRig]
) -> None:
    transferred = torch.stack([transfer_with_report(template, other.neutral).rig.deltas for other in others])
    truth = torch.stack([other.deltas for other in others])
    assert float((transferred - truth).norm()) < 0.8 * float((template.deltas - truth).norm())


@pytest.mark.bench
def test_lids_of_other_performers_close_where_their_own_do(
    template: BlendshapeRig, others: list[BlendshapeRig]
) -> None:
    blink = template.select(["eyeBlinkLeft", "eyeBlinkRight"])
    annotations = template.neutral.annotations
    first, second = annotations.contacts.T
    pose = template.vertices + blink.deltas.sum(0)
    meet = (pose[first] - pose[second]).norm(dim=-1) < 0.1
    part = (template.vertices[first] - template.vertices[second]).norm(dim=-1) > 3
    assert int((meet & part).sum()) > 20
    first, second = first[meet & part], second[meet & part]

    def gap(rig: BlendshapeRig) -> float:
        shut = rig.vertices + rig.deltas.sum(0)
        return float((shut[first] - shut[second]).norm(dim=-1).max())

    held = max(gap(transfer_with_report(blink, other.neutral).rig) for other in others)
    free = max(gap(transfer_with_report(blink, other.neutral, contact_weight=0.0).rig) for other in others)
    assert held < 0.1 * free
    assert held < 0.1
