"""Frames one at a time give what the batch gives, and get there in time."""

from __future__ import annotations

import pytest
import torch

from torchface import BlendshapeRig
from torchface.capture import MarkerSolver
from torchface.errors import ShapeError, ValueRangeError
from torchface.onnx.live_solver import LiveMarkerSolver
from torchface.onnx.solver_graph_export import hide_markers, random_frames
from torchface.synthetic.stages.marker_stage import place_markers


@pytest.fixture(scope="module")
def solver(dome_rig: BlendshapeRig) -> MarkerSolver:
    return MarkerSolver(dome_rig, place_markers(dome_rig, 30))


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_frame_by_frame_is_the_batch(solver: MarkerSolver, share: float) -> None:
    markers = hide_markers(random_frames(solver, 60), share)
    live = LiveMarkerSolver(solver)
    solved = torch.stack([live.step(frame) for frame in markers])
    torch.testing.assert_close(solved, solver(markers), rtol=0, atol=2e-3)


def test_a_frame_without_markers_keeps_the_weights(solver: MarkerSolver) -> None:
    live, markers = LiveMarkerSolver(solver), random_frames(solver, 1)[0]
    before = live.step(markers)
    torch.testing.assert_close(live.step(torch.full_like(markers, torch.nan)), before, rtol=0, atol=1e-6)
    live.reset()
    assert not live.step(torch.full_like(markers, torch.nan)).any()


def test_bad_frames(solver: MarkerSolver) -> None:
    live = LiveMarkerSolver(solver)
    with pytest.raises(ShapeError, match="expected \\(30,3\\)"):
        live.step(torch.zeros(29, 3))
    with pytest.raises(ValueRangeError, match="infinite"):
        live.step(torch.full((30, 3), torch.inf))
