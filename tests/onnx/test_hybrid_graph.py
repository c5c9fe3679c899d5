"""The hybrid graph is the hybrid solve, and ONNX Runtime computes the graph."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor

from torchface import BlendshapeRig
from torchface.capture import HybridSolver, MarkerSolver
from torchface.onnx import HybridGraph, SolverGraph, export_hybrid_solver
from torchface.onnx.solver_graph_export import hide_markers, random_frames
from torchface.synthetic.stages.marker_stage import place_markers


@pytest.fixture(scope="module")
def solver(dome_rig: BlendshapeRig) -> MarkerSolver:
    return MarkerSolver(dome_rig, place_markers(dome_rig, 30))


def predictions(solver: MarkerSolver, frames: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    predicted = torch.rand(frames, len(solver.names), generator=generator)
    gamma = 4 * torch.rand(predicted.shape, generator=generator) * (predicted > 0.5)
    return torch.where(gamma > 0, predicted, torch.nan), gamma


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_many_steps_are_the_exact_solve(solver: MarkerSolver, share: float) -> None:
    markers = hide_markers(random_frames(solver, 40), share).double()
    predicted, gamma = (values.double() for values in predictions(solver, 40))
    graph = HybridGraph(solver, steps=1500, steps_with_gaps=1500).double()
    start = torch.rand(40, len(solver.names), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    exact = HybridSolver(solver)(markers, predicted, gamma)
    torch.testing.assert_close(graph(markers, start, predicted, gamma), exact, rtol=0, atol=1e-5)


def test_without_gamma_it_is_the_marker_graph_bit_for_bit(solver: MarkerSolver) -> None:
    markers = random_frames(solver, 9)
    start = torch.zeros(9, len(solver.names))
    alone = SolverGraph(solver)(markers, start)
    assert torch.equal(HybridGraph(solver)(markers, start, start + torch.nan, start), alone)


def test_the_file_computes_it_and_says_what_it_takes(
    dome_rig: BlendshapeRig, solver: MarkerSolver, tmp_path: Path
) -> None:
    path = tmp_path / "hybrid.onnx"
    report = export_hybrid_solver(dome_rig, place_markers(dome_rig, 30), path)
    assert max(gap.parity for gap in report.gaps) <= 1e-5
    assert max(gap.worst for gap in report.gaps) <= 1e-4
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    markers = random_frames(solver, 8)
    predicted, gamma = predictions(solver, 8)
    inputs = {"markers": markers, "previous": torch.zeros_like(gamma), "predicted": predicted, "gamma": gamma}
    (weights,) = session.run(["weights"], {name: value.numpy() for name, value in inputs.items()})
    exact = HybridSolver(solver)(markers.double(), predicted.double(), gamma.double())
    np.testing.assert_allclose(weights, exact.numpy(), atol=2e-3)
    metadata = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
    assert metadata["task"] == "hybrid_solver"
    assert json.loads(metadata["shape_names"]) == list(dome_rig.names)
