"""The fixed-step module is the marker solve and the hybrid solve."""

import pytest
import torch
from torch import Tensor

from torchface import BlendshapeRig
from torchface.capture import HybridSolver, MarkerSolver
from torchface.errors import ShapeError
from torchface.onnx import SolverGraph
from torchface.onnx.solver_graph_export import hide_markers, random_frames
from torchface.optim import FixedSplitting
from torchface.synthetic.stages.marker_stage import place_markers


def many_steps(solver: MarkerSolver) -> SolverGraph:
    return SolverGraph(
        solver, FixedSplitting(solver.complete_hessian(), steps=1500), FixedSplitting(steps=1500)
    ).double()


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.3])
def test_many_steps_are_the_exact_solve(
    bumps: MarkerSolver, turned_bumps: MarkerSolver, turned: bool, share: float
) -> None:
    solver = turned_bumps if turned else bumps
    markers = hide_markers(random_frames(solver, 40), share).double()
    start = torch.rand(40, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = many_steps(solver)(markers, start)
    torch.testing.assert_close(found, solver(markers), rtol=0, atol=1e-6)


def test_a_frame_without_markers_keeps_the_weights_before(bumps: MarkerSolver) -> None:
    markers = random_frames(bumps, 3)
    markers[1] = torch.nan
    before = torch.rand(3, 10, generator=torch.Generator().manual_seed(0))
    held = SolverGraph(bumps)(markers, before)
    torch.testing.assert_close(held[1], before[1], rtol=0, atol=0)
    led = SolverGraph(bumps)(markers, before, 1 - before, torch.ones_like(before))
    torch.testing.assert_close(led[1], before[1], rtol=0, atol=0)


def test_inputs_of_another_shape_are_refused(bumps: MarkerSolver) -> None:
    graph = SolverGraph(bumps)
    with pytest.raises(ShapeError, match=r"expected \(B,36,3\) and \(B,10\)"):
        graph(torch.zeros(2, 36, 3), torch.zeros(1, 10))
    with pytest.raises(ShapeError, match=r"gamma \(2, 9\), expected \(B,36,3\) and \(B,10\)"):
        graph(torch.zeros(2, 36, 3), torch.zeros(2, 10), torch.zeros(2, 10), torch.zeros(2, 9))


@pytest.fixture(scope="module")
def dome(dome_rig: BlendshapeRig) -> MarkerSolver:
    return MarkerSolver(dome_rig, place_markers(dome_rig, 30))


def predictions(solver: MarkerSolver, frames: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    predicted = torch.rand(frames, len(solver.names), generator=generator)
    gamma = 4 * torch.rand(predicted.shape, generator=generator) * (predicted > 0.5)
    return torch.where(gamma > 0, predicted, torch.nan), gamma


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_many_steps_with_predictions_are_the_hybrid_solve(dome: MarkerSolver, share: float) -> None:
    markers = hide_markers(random_frames(dome, 40), share).double()
    predicted, gamma = (values.double() for values in predictions(dome, 40))
    start = torch.rand(40, len(dome.names), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    exact = HybridSolver(dome)(markers, predicted, gamma)
    torch.testing.assert_close(many_steps(dome)(markers, start, predicted, gamma), exact, rtol=0, atol=1e-5)


def test_without_gamma_it_is_the_marker_solve_bit_for_bit(dome: MarkerSolver) -> None:
    markers, start, graph = random_frames(dome, 9), torch.zeros(9, len(dome.names)), SolverGraph(dome)
    assert torch.equal(graph(markers, start, start + torch.nan, start), graph(markers, start))
