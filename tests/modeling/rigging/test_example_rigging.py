"""Rigs learned from examples whose true shapes are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from planted.asked_expressions import EXAMPLES
from torchface import BlendshapeRig, Mesh, TorchfaceError
from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.modeling import RiggingSchedule, rig_from_examples, transfer_with_report
from torchface.modeling.rigging.example_gradients import example_shares, personal_part, shape_stiffness
from torchface.modeling.rigging.example_rigging import angles_between
from torchface.optim import box_qp
from torchface.synthetic import draw_identities, performer

SHORT = RiggingSchedule(iterations=4)
KNOWN = RiggingSchedule(iterations=2, gamma=(1e9, 1e9))


def dome(height: float, side: int = 21) -> Mesh:
    axis = torch.linspace(-50, 50, side, dtype=torch.float64)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    corner = (torch.arange(side - 1)[:, None] * side + torch.arange(side - 1)).reshape(-1)
    quads = torch.stack([corner, corner + 1, corner + side + 1, corner + side], dim=1)
    vertices = torch.stack([x, y, height - (x**2 + y**2) * height / 5000], dim=-1).reshape(-1, 3)
    return Mesh.from_polygons(vertices, quads)


def bulges(mesh: Mesh, directions: list[list[float]], sharpness: float = 1.0) -> Tensor:
    """Three shapes of bounded support; a person's differ in direction and in how sharply they fall."""
    at = mesh.vertices[:, :2]
    centres = torch.tensor([[-20.0, 20], [20, 15], [0, -20]], dtype=torch.float64)
    near = (1 - (at - centres[:, None]).square().sum(-1) / 25**2).clamp(min=0) ** (2 * sharpness)
    return near[..., None] * torch.tensor(directions, dtype=torch.float64)[:, None]


@pytest.fixture(scope="module")
def template() -> BlendshapeRig:
    mesh = dome(50)
    return BlendshapeRig(mesh, bulges(mesh, [[0, 2, 6], [3, 0, 5], [0, -5, 3]]), ["a", "b", "c"])


@pytest.fixture(scope="module")
def person() -> BlendshapeRig:
    mesh = dome(60)
    return BlendshapeRig(mesh, bulges(mesh, [[1, 2, 9], [3, 1, 3], [0, -6, 5]], 1.4), ["a", "b", "c"])


def error(rig: BlendshapeRig, weights: Tensor, goal: Tensor) -> float:
    return float((rig(weights) - goal).square().sum(-1).mean(-1).sqrt().mean())


def best_weights(rig: BlendshapeRig, goal: Tensor) -> Tensor:
    shapes = rig.deltas.double().flatten(1)
    hessian = shapes @ shapes.T + 1e-3 * torch.eye(len(shapes), dtype=torch.float64)
    return box_qp(hessian, -(goal - rig.vertices).double().flatten(1) @ shapes.T).to(goal)


def test_the_triangles_system_agrees_with_dense_least_squares() -> None:
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(4, 7, dtype=torch.float64, generator=generator)
    residuals = torch.randn(4, 11, 9, dtype=torch.float64, generator=generator)
    compliance = 10 * torch.rand(7, 11, dtype=torch.float64, generator=generator)
    compliance[2, 5] = 0
    found = personal_part(example_shares(residuals, weights, compliance), weights, compliance)
    for triangle in range(11):
        root = np.sqrt(compliance[:, triangle].numpy())
        # With D = sqrt(c) y the problem is ridge regression of y.
        stacked = np.concatenate([weights.numpy() * root, np.eye(7)])
        wanted = np.concatenate([residuals[:, triangle].numpy(), np.zeros((7, 9))])
        y = np.linalg.lstsq(stacked, wanted, rcond=None)[0]
        np.testing.assert_allclose(found[:, triangle].numpy(), root[:, None] * y, atol=1e-10)
    assert (found[2, 5] == 0).all()


def test_stiffness_is_high_where_the_template_is_still() -> None:
    changes = torch.zeros(1, 3, 3, 3)
    changes[0, 1, 0, 0] = 0.4
    changes[0, 2] = 1e4
    still, some, much = shape_stiffness(changes, 0.1, 2.0)[0].tolist()
    assert still == pytest.approx(100.0)
    assert some == pytest.approx((1.4 / 0.5) ** 2)
    assert much == pytest.approx(1.0, abs=1e-3)


def test_one_example_a_shape_gives_the_persons_own_shapes(template: BlendshapeRig, person: BlendshapeRig) -> None:
    weights = torch.eye(3, dtype=torch.float64)
    firm = RiggingSchedule(iterations=1, beta=(1e-9, 1e-9), gamma=(1e9, 1e9))
    made = rig_from_examples(template, person.neutral, person(weights), weights, firm)
    # What is not recovered is the person's moving where the template is still.
    missing = (made.rig.deltas - person.deltas).norm(dim=-1)
    assert float(missing.max()) < 0.05
    assert float((made.transferred.deltas - person.deltas).norm(dim=-1).max()) > 2


def test_a_mixture_is_shared_out_by_where_each_shape_moves(template: BlendshapeRig, person: BlendshapeRig) -> None:
    weights = torch.ones(1, 3, dtype=torch.float64)
    made = rig_from_examples(template, person.neutral, person(weights), weights, KNOWN)
    before = (made.transferred.deltas - person.deltas).flatten(1).norm(dim=1)
    after = (made.rig.deltas - person.deltas).flatten(1).norm(dim=1)
    assert (after < 0.6 * before).all()


def test_nothing_is_learned_from_what_transfer_already_gives(template: BlendshapeRig, person: BlendshapeRig) -> None:
    transferred = transfer_with_report(template, person.neutral).rig
    weights = torch.tensor([[0.7, 0.2, 0.4], [0.0, 0.9, 1.0]], dtype=torch.float64)
    made = rig_from_examples(template, person.neutral, transferred(weights), weights, SHORT)
    torch.testing.assert_close(made.rig.deltas, transferred.deltas, atol=1e-6, rtol=0)
    torch.testing.assert_close(made.transferred.deltas, transferred.deltas, atol=1e-9, rtol=0)
    torch.testing.assert_close(made.weights, weights, atol=1e-6, rtol=0)
    assert float(made.errors.max()) < 1e-6
    assert float(made.angles.max()) < 1e-3


def test_weights_may_be_whole_numbers_or_arrays(template: BlendshapeRig, person: BlendshapeRig) -> None:
    weights = torch.eye(3, dtype=torch.float64)
    shown = person(weights)
    wanted = rig_from_examples(template, person.neutral, shown, weights, SHORT)
    for given in ((shown, weights.long()), (shown.numpy(), weights.numpy())):
        made = rig_from_examples(template, person.neutral, *given, SHORT)
        torch.testing.assert_close(made.weights.double(), wanted.weights, rtol=0, atol=1e-6)


def test_wrong_weights_are_put_right(template: BlendshapeRig, person: BlendshapeRig) -> None:
    truth = torch.tensor([[0.8, 0.0, 0.5], [0.3, 0.6, 0.0], [0.0, 0.4, 0.9]], dtype=torch.float64)
    transferred = transfer_with_report(template, person.neutral).rig
    given = (truth + torch.tensor([[-0.2, 0.1, 0.1], [0.2, -0.1, 0.1], [0.1, 0.2, -0.2]])).clamp(0, 1)
    made = rig_from_examples(template, person.neutral, transferred(truth), given)
    assert float((made.weights - truth).norm()) < 0.2 * float((given - truth).norm())


def test_last_weights_are_the_best_in_the_box(template: BlendshapeRig, person: BlendshapeRig) -> None:
    weights = torch.tensor([[1.0, 0.5, 0.0], [0.2, 0.0, 1.0]], dtype=torch.float64)
    stronger = person.neutral.vertices + 1.3 * (person(weights) - person.neutral.vertices)
    made = rig_from_examples(template, person.neutral, stronger, weights, SHORT)
    scale = float(made.report.similarity.scale[0])
    shapes = made.rig.deltas.flatten(1).T.numpy() / scale
    offsets = ((stronger - person.vertices) / scale).flatten(1).numpy()
    transferred = made.transferred.deltas.flatten(1).T.numpy() / scale
    left = np.mean([2 * lsq_linear(transferred, offset, (0, 1), tol=1e-14).cost for offset in offsets])
    pulls = np.sqrt(SHORT.gamma[1] * left * np.where(weights > 0, 1, SHORT.unnamed))
    for found, given, offset, pull in zip(made.weights, weights, offsets, pulls, strict=True):
        best = lsq_linear(
            np.concatenate([shapes, np.diag(pull)]),
            np.concatenate([offset, pull * given.numpy()]),
            (0, 1),
            tol=1e-14,
        )
        np.testing.assert_allclose(found.numpy(), best.x, atol=1e-6)
    assert (made.weights == 1).any()


def test_a_turned_scaled_person_has_turned_scaled_shapes(template: BlendshapeRig, person: BlendshapeRig) -> None:
    skew = torch.tensor([[0.0, -0.5, 0.3], [0.5, 0, -0.9], [-0.3, 0.9, 0]], dtype=torch.float64)
    turn = 1.25 * torch.linalg.matrix_exp(skew)
    shift = torch.tensor([30.0, -80, 5], dtype=torch.float64)
    weights = torch.tensor([[0.9, 0.3, 0.0], [0.0, 0.5, 0.8]], dtype=torch.float64)
    examples = person(weights)
    made = rig_from_examples(template, person.neutral, examples, weights, SHORT)
    moved_neutral = person.neutral.with_vertices(person.vertices @ turn.T + shift)
    moved = rig_from_examples(template, moved_neutral, examples @ turn.T + shift, weights, SHORT)
    torch.testing.assert_close(moved.rig.deltas, made.rig.deltas @ turn.T, atol=1e-6, rtol=0)
    torch.testing.assert_close(moved.weights, made.weights, atol=1e-7, rtol=0)
    torch.testing.assert_close(moved.errors, 1.25 * made.errors, atol=1e-7, rtol=1e-7)


def test_what_the_template_leaves_still_stays_still(template: BlendshapeRig, person: BlendshapeRig) -> None:
    weights = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    everywhere = person(weights) + torch.tensor([0.0, 0.0, 1.0]) * torch.cos(person.vertices[:, :1] / 10)
    made = rig_from_examples(template, person.neutral, everywhere, weights, SHORT)
    still = (template.deltas == 0).all(-1)
    assert still.any(1).all()
    assert float(made.rig.deltas[still].abs().max()) < 1e-12
    assert (made.rig.deltas[1] == made.transferred.deltas[1]).all() or (made.weights[0, 1] > 0)


def test_errors_fall_and_the_record_is_that_of_the_rig(template: BlendshapeRig, person: BlendshapeRig) -> None:
    weights = torch.tensor([[0.9, 0.3, 0.0], [0.0, 0.5, 0.8]], dtype=torch.float64)
    goal, rounds = person(weights), []
    made = rig_from_examples(
        template, person.neutral, goal, weights, SHORT, progress=lambda _, done, of: rounds.append((done, of))
    )
    assert rounds == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert made.errors.shape == (5, 2)
    assert float(made.errors[0].mean()) == pytest.approx(error(made.transferred, weights, goal))
    assert float(made.errors[-1].mean()) == pytest.approx(error(made.rig, made.weights, goal))
    assert (made.errors[1:] <= made.errors[:-1] + 1e-9).all()
    again = rig_from_examples(template, person.neutral, goal, weights, SHORT)
    assert torch.equal(again.rig.deltas, made.rig.deltas)
    assert torch.equal(again.weights, made.weights)


def test_angles_between_shapes() -> None:
    first = torch.tensor([[[1.0, 0, 0]], [[1, 0, 0]], [[0, 0, 0]]])
    second = torch.tensor([[[0.0, 2, 0]], [[3, 3, 0]], [[1, 0, 0]]])
    assert angles_between(first, second).tolist() == pytest.approx([90.0, 45.0, 0.0], abs=1e-4)


@pytest.fixture(scope="module")
def average() -> BlendshapeRig:
    return performer(texture=False)


@pytest.mark.parametrize("guess", [False, pytest.param(True, marks=pytest.mark.bench)])
def test_eight_examples_make_another_performers_rig(average: BlendshapeRig, guess: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    actor = performer(draw_identities(1, generator)[0], texture=False)
    weights = torch.stack([torch.tensor([0.9 * (name in line.split()) for name in average.names]) for line in EXAMPLES])
    unseen = torch.rand(20, len(average.names), generator=generator)
    unseen = unseen * (torch.rand(unseen.shape, generator=generator) < 0.15)
    examples, goals = actor(weights), actor(unseen)
    # Weights as a person would guess them: wrong by a tenth or two where a shape is on, with a few that are not.
    noise = 0.15 * torch.randn(weights.shape, generator=generator)
    guessed = (weights + noise * ((weights > 0) | (torch.rand(weights.shape, generator=generator) < 0.05))).clamp(0, 1)
    loose = replace(SHORT, gamma=(10.0, 10.0))
    given, schedule = (guessed, loose) if guess else (weights, SHORT)
    made = rig_from_examples(average, actor.neutral, examples, given, schedule)
    assert float(made.errors[-1].mean()) < 0.4 * error(made.transferred, weights, examples)
    before, after = (error(rig, best_weights(rig, goals), goals) for rig in (made.transferred, made.rig))
    assert after < 0.75 * before
    assert float(made.angles.max()) < 30
    if not guess:
        assert error(made.rig, unseen, goals) < 0.85 * error(made.transferred, unseen, goals)


def test_how_far_lips_part_is_learned(average: BlendshapeRig) -> None:
    annotations = average.neutral.annotations
    template = average.select(["mouthUpperUpLeft", "mouthUpperUpRight", "mouthLowerDownLeft", "mouthLowerDownRight"])
    actor = BlendshapeRig(average.neutral, 1.6 * template.deltas, template.names)
    weights = torch.ones(1, 4)
    trusting = RiggingSchedule(iterations=1, beta=(1e-4, 1e-4), gamma=(1e9, 1e9))
    made = rig_from_examples(template, actor.neutral, actor(weights), weights, trusting)
    first, second = annotations.contacts.T

    def gap(rig: BlendshapeRig) -> Tensor:
        pose = rig(weights)[0]
        return (pose[first] - pose[second]).norm(dim=-1)

    parts = gap(actor) > gap(template) + 1.5
    assert int(parts.sum()) > 10
    learned = (gap(made.rig) - gap(template))[parts] / (gap(actor) - gap(template))[parts]
    assert float(learned.min()) > 0.8


@pytest.mark.parametrize(
    ("changed", "kind", "says"),
    [
        ({"examples": torch.zeros(2, 9, 3)}, TopologyError, "9 vertices, expected the template's 441"),
        ({"examples": torch.zeros(441, 3)}, ShapeError, r"\(441, 3\), expected \(M,441,3\)"),
        ({"examples": torch.zeros(0, 441, 3), "weights": torch.zeros(0, 3)}, ShapeError, "expected at least one"),
        ({"examples": torch.full((2, 441, 3), torch.nan)}, ValueRangeError, r"examples: .* rows \[0, 1\]"),
        ({"weights": torch.zeros(2, 4)}, ShapeError, r"\(2, 4\), expected \(2,3\)"),
        ({"weights": torch.zeros(1, 3)}, ShapeError, r"\(1, 3\), expected \(2,3\)"),
        ({"weights": torch.tensor([[0, 0, 0], [0, 1.2, 0]])}, ValueRangeError, r"to 1.2 \(examples \[1\]\)"),
        ({"weights": torch.tensor([[0, torch.nan, 0], [0, 0, 0]])}, ValueRangeError, r"weights: .* rows \[0\]"),
        ({"neutral": dome(50, side=9)}, TopologyError, "neutral: found 81 vertices"),
        ({"contact_weight": -1.0}, ValueRangeError, "contact_weight"),
    ],
)
def test_bad_input_is_named(
    changed: dict[str, object], kind: type[TorchfaceError], says: str, template: BlendshapeRig, person: BlendshapeRig
) -> None:
    arguments: dict[str, object] = {
        "template": template,
        "neutral": person.neutral,
        "examples": person(torch.ones(2, 3, dtype=torch.float64)),
        "weights": torch.ones(2, 3, dtype=torch.float64),
    }
    with pytest.raises(kind, match=says):
        rig_from_examples(**(arguments | changed))


@pytest.mark.parametrize(
    "numbers", [{"iterations": 0}, {"beta": (0.5, 0.0)}, {"gamma": (torch.nan, 1.0)}, {"kappa": -0.1}, {"theta": 0.0}]
)
def test_schedules_without_sense_are_refused(numbers: dict[str, float]) -> None:
    with pytest.raises(ValueRangeError, match=next(iter(numbers))):
        RiggingSchedule(**numbers)
