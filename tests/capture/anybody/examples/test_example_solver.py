"""Planted weights come back; the minima are those that independent solvers find; gradients are those of differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from torch import Tensor

from torchface.capture import ExampleSolver
from torchface.capture.anybody import (
    AllAtOnce,
    ExampleShapes,
    LandmarkBoxes,
    LandmarkModel,
    Regional,
    SolvedSimilarity,
    SquaredDistances,
)
from torchface.capture.anybody.examples.example_methods import ExampleMethod
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError

FREE = {"sparsity": 0.0, "ridge": 0.0}
SQUARES = SquaredDistances(**FREE)


def shown(examples: ExampleShapes, weights: Tensor) -> Tensor:
    """The examples' landmarks at weights (B,N), (B,68,2) float64."""
    return examples.neutral.double() + torch.einsum("pcn,bn->bpc", examples.basis.double(), weights)


def methods(examples: ExampleShapes) -> list[ExampleMethod]:
    """Each solver without penalties."""
    model = LandmarkModel.fit(examples, variance=1.0, noise=0.0, **FREE)
    return [AllAtOnce(SQUARES), Regional(SQUARES), model]


def of_regions(examples: ExampleShapes) -> ExampleShapes:
    """Examples whose expressions move the landmarks of their own region alone, as the regional solver takes them to."""
    brows, mouth = list(range(17, 27)), [*range(17), *range(48, 68)]
    landmarks = examples.neutral.expand(len(examples.names), -1, -1).clone()
    for row, name in enumerate(examples.names):
        moved = brows if name.startswith("brow") else mouth
        rows = list(range(68)) if name.startswith(("rotate", "tilt")) else moved
        landmarks[row, rows] = examples.landmarks[row, rows]
    return replace(examples, landmarks=landmarks)


def turned(points: Tensor, angle: float, size: float, shift: tuple[float, float]) -> Tensor:
    turn = torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return size * points @ turn.T + torch.tensor(shift, dtype=torch.float64)


@pytest.mark.parametrize("number", range(3))
def test_planted_weights_and_placement_come_back(examples: ExampleShapes, planted: Tensor, number: int) -> None:
    known = of_regions(examples)
    # With roll and size solved for, shapes that tilt the head say nothing new.
    known = known.select(known.names[:13])
    weights = planted[:, :13]
    landmarks = turned(shown(known, weights), 0.3, 1.7, (200, -40))
    solver = ExampleSolver(known, methods(known)[number], SolvedSimilarity())
    fit = solver.fit(landmarks)
    assert (fit.weights - weights).abs().max() < 1e-5
    assert (solver.landmarks(fit) - landmarks).abs().max() < 1e-3
    turn = torch.atan2(fit.placement.matrix[:, 1, 0], fit.placement.matrix[:, 0, 0])
    assert torch.allclose(turn, torch.full_like(turn, 0.3), atol=1e-4)


@pytest.mark.parametrize("number", range(3))
def test_planted_brows_come_back_by_the_papers_boxes(examples: ExampleShapes, planted: Tensor, number: int) -> None:
    """Of the paper's shapes the brows' alone leave the box where it is."""
    known = of_regions(examples)
    weights = planted.clone()
    weights[:, 4:] = 0
    landmarks = shown(known, weights) * torch.tensor([1.3, 0.9]) + torch.tensor([30.0, 80.0])
    solver = ExampleSolver(known, methods(known)[number], LandmarkBoxes())
    fit = solver.fit(landmarks)
    assert (fit.weights - weights).abs().max() < 1e-5
    assert torch.allclose(fit.placement.matrix.diagonal(dim1=1, dim2=2), torch.tensor([1.3, 0.9]).double(), atol=1e-5)


def test_an_open_jaw_deceives_the_boxes_but_not_the_similarity(examples: ExampleShapes) -> None:
    weights = torch.zeros(1, 15, dtype=torch.float64)
    weights[0, examples.names.index("pull_open")] = 0.8
    landmarks = shown(examples, weights)
    errors = [
        float((ExampleSolver(examples, AllAtOnce(SQUARES), placement)(landmarks) - weights).abs().max())
        for placement in (LandmarkBoxes(), SolvedSimilarity())
    ]
    assert errors[0] > 0.1
    assert errors[1] < 1e-5


def noisy(examples: ExampleShapes, weights: Tensor, pixels: float = 1.5) -> Tensor:
    points = shown(examples, weights)
    return points + pixels * torch.randn(points.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def boxes_by_numpy(landmarks: np.ndarray, neutral: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    kept = [*range(17), *range(27, 68)]
    low, high = landmarks[kept].min(0), landmarks[kept].max(0)
    low0, high0 = neutral[kept].min(0), neutral[kept].max(0)
    scale = (high - low) / (high0 - low0)
    return scale, (high + low) / 2 - scale * (high0 + low0) / 2


def test_squared_distances_agree_with_lsq_linear(examples: ExampleShapes, planted: Tensor) -> None:
    landmarks = noisy(examples, planted)
    solver = ExampleSolver(examples, AllAtOnce(SQUARES))
    ours = solver(landmarks).numpy()
    neutral, basis = examples.neutral.double().numpy(), examples.basis.double().numpy()
    for frame, weights in zip(landmarks.numpy(), ours, strict=True):
        scale, shift = boxes_by_numpy(frame, neutral)
        matrix = (basis * scale[None, :, None]).reshape(136, -1)
        target = (frame - (neutral * scale + shift)).reshape(-1)
        theirs = lsq_linear(matrix, target, (0, 1), tol=1e-14)
        assert np.abs(weights - theirs.x).max() < 1e-4
        # Where shapes look alike weights may differ, the error not.
        assert ((matrix @ weights - target) ** 2).sum() <= 2 * theirs.cost * (1 + 1e-9)


@pytest.mark.parametrize("placement", [LandmarkBoxes(), SolvedSimilarity()])
@pytest.mark.parametrize("kind", ["squared", "regional", "model"])
def test_gradients_are_those_of_differences(
    examples: ExampleShapes, planted: Tensor, kind: str, placement: LandmarkBoxes | SolvedSimilarity
) -> None:
    known = examples.select(examples.names[:13])
    made: dict[str, ExampleMethod] = {
        "squared": AllAtOnce(SquaredDistances(1e-5, 1e-5)),
        "regional": Regional(SquaredDistances(1e-5, 1e-5)),
        "model": LandmarkModel.fit(known, ridge=1e-5),
    }
    solver = ExampleSolver(known, made[kind], placement)
    landmarks = noisy(known, planted[4:6, :13]).requires_grad_()
    along = torch.randn(2, 13, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def value(points: Tensor) -> Tensor:
        return (solver(points) * along).sum()

    (slope,) = torch.autograd.grad(value(landmarks), landmarks)
    direction = torch.randn(landmarks.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    step = 1e-3
    with torch.no_grad():
        difference = (value(landmarks + step * direction) - value(landmarks - step * direction)) / (2 * step)
    assert float((slope * direction).sum()) == pytest.approx(float(difference), rel=1e-4, abs=1e-7)


def test_what_is_not_seen_does_not_count(examples: ExampleShapes, planted: Tensor) -> None:
    known = examples.select(examples.names[:13])
    weights = planted[:, :13]
    landmarks = turned(shown(known, weights), -0.2, 0.6, (10, 20))
    landmarks[0, :9] = torch.nan
    landmarks[1, 48:54, 0] = torch.nan
    landmarks[2, 36:42] = torch.nan
    for method in (AllAtOnce(SQUARES), methods(known)[2]):
        assert (ExampleSolver(known, method, SolvedSimilarity())(landmarks) - weights).abs().max() < 1e-5


def test_the_regional_base_holds_no_expression(examples: ExampleShapes, planted: Tensor) -> None:
    """The paper's base held that of the frame before, and so depended on it."""
    landmarks = noisy(examples, planted)
    solver = ExampleSolver(examples, Regional())
    again = solver(landmarks, torch.rand(12, 15, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    assert torch.allclose(solver(landmarks), again, atol=1e-7)


def test_suck_belongs_to_the_mouth(examples: ExampleShapes) -> None:
    regions = dict(zip(examples.names, ExampleSolver(examples).regions, strict=True))
    assert {name for name, region in regions.items() if region == "brows"} == set(examples.names[:4])
    assert {name for name, region in regions.items() if region == "head"} == set(examples.names[11:])
    assert regions["suck"] == regions["pucker"] == "mouth"


def test_the_l1_penalty_makes_fewer_shapes_active(examples: ExampleShapes, planted: Tensor) -> None:
    landmarks = noisy(examples, planted)
    penalties = (SQUARES, SquaredDistances(sparsity=1e-4))
    counts = [int((ExampleSolver(examples, AllAtOnce(one))(landmarks) > 0.01).sum()) for one in penalties]
    assert counts[1] < 0.85 * counts[0]


@given(
    size=st.floats(0.05, 20),
    x=st.floats(-5e3, 5e3),
    y=st.floats(-5e3, 5e3),
    order=st.permutations(list(range(15))),
    similarity=st.booleans(),
)
@settings(max_examples=12)
def test_size_place_and_order_do_not_matter(
    examples: ExampleShapes, planted: Tensor, size: float, x: float, y: float, order: list[int], similarity: bool
) -> None:
    """The picture's size is the unit of nothing, and examples go by name."""
    landmarks = noisy(examples, planted)[:4]
    placement = SolvedSimilarity() if similarity else LandmarkBoxes()
    weights = ExampleSolver(examples, None, placement)(landmarks)
    assert bool(((weights >= 0) & (weights <= 1)).all())
    moved = size * landmarks + torch.tensor([x, y], dtype=torch.float64)
    shuffled = examples.select([examples.names[i] for i in order])
    again = ExampleSolver(shuffled, None, placement)(moved)
    assert torch.allclose(again, weights[:, order], atol=1e-5)


def test_examples_that_look_alike_share_their_weight(examples: ExampleShapes) -> None:
    """H is singular: any share is a minimum, and the ridge takes equal ones."""
    twin = ExampleShapes(
        ("one", "other", "brow_raise_left"),
        examples.neutral,
        torch.stack([examples.landmarks[5], examples.landmarks[5], examples.landmarks[1]]),
    )
    landmarks = (examples.neutral + 0.6 * (examples.landmarks[5] - examples.neutral))[None].double()
    weights = ExampleSolver(twin, AllAtOnce(SquaredDistances(0.0, 1e-9)), SolvedSimilarity())(landmarks)
    assert torch.allclose(weights, torch.tensor([[0.3, 0.3, 0.0]]).double(), atol=1e-3)


@pytest.mark.parametrize("number", range(3))
def test_a_solver_comes_back_from_its_config_and_state(examples: ExampleShapes, planted: Tensor, number: int) -> None:
    solver = ExampleSolver(examples, methods(examples)[number], SolvedSimilarity() if number % 2 else None)
    again = ExampleSolver.from_config(solver.config)
    again.load_state_dict(solver.state_dict())
    landmarks = noisy(examples, planted).float()
    assert torch.equal(again(landmarks), solver(landmarks))


def test_mistakes_are_said(examples: ExampleShapes) -> None:
    solver = ExampleSolver(examples)
    with pytest.raises(ShapeError, match=r"expected \(B,68,2\)"):
        solver(torch.zeros(1, 67, 2))
    with pytest.raises(ShapeError, match=r"found \(1, 16\), expected \(1,15\)"):
        solver(torch.rand(1, 68, 2), torch.zeros(1, 16))
    with pytest.raises(ValueRangeError, match="found 0 in frame 1 and too few in 1 of 2 frames"):
        solver(torch.stack([examples.neutral, torch.full((68, 2), torch.nan)]))
    with pytest.raises(ValueRangeError, match="infinite in frames"):
        solver(torch.full((1, 68, 2), torch.inf))
    assert torch.equal(solver(examples.neutral[None].tolist()), solver(examples.neutral[None]))
    with pytest.raises(ValueRangeError, match="all the neutral"):
        ExampleSolver(replace(examples, landmarks=examples.neutral.expand(15, -1, -1)))
    with pytest.raises(ValueRangeError, match="sparsity"):
        SquaredDistances(sparsity=-1.0)
    with pytest.raises(NameMismatchError, match="distinct names"):
        ExampleSolver.from_config({**solver.config, "names": ["a", "a"]})
    with pytest.raises(ValueRangeError, match="expected one of all_at_once, regional"):
        ExampleSolver.from_config({**solver.config, "method": {**solver.config["method"], "kind": "os.system"}})
