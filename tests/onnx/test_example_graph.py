"""The graph of an example solver is its solve: one frame, many, and with landmarks missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from torchface import zoo
from torchface.capture import ExampleSolver
from torchface.capture.anybody import (
    AllAtOnce,
    Distances,
    ExampleShapes,
    LandmarkModel,
    Regional,
    SolvedSimilarity,
    SquaredDistances,
    paper_examples,
)
from torchface.errors import ValueRangeError
from torchface.onnx import export_example_solver
from torchface.onnx.example_graph import example_model
from torchface.onnx.placed_example_graph import PlacedExamples
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def examples() -> ExampleShapes:
    return paper_examples(performer(texture=False))


@pytest.mark.parametrize("kind", ["all", "regional", "model"])
def test_many_steps_are_the_exact_solve(examples: ExampleShapes, kind: str) -> None:
    squared = SquaredDistances(2e-5, 1e-5)
    method = {
        "all": AllAtOnce(squared),
        "regional": Regional(squared),
        "model": LandmarkModel.fit(examples, ridge=1e-5, variance=0.999),
    }[kind]
    solver = ExampleSolver(examples, method)
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(6, 15, generator=generator) * (torch.rand(6, 15, generator=generator) < 0.3)
    frames = examples.neutral + torch.einsum("pcn,bn->bpc", examples.basis, weights)
    frames = (frames + torch.randn(frames.shape, generator=generator)) * torch.tensor([1.4, 0.9])
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    content = example_model(solver, 60, 60).SerializeToString()
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    exact = solver(frames.double()).numpy()
    many = session.run(["weights"], {"landmarks": frames.numpy(), "previous": np.zeros((6, 15), np.float32)})[0]
    assert np.abs(many - exact).max() < 5e-3
    for frame, wanted in zip(frames.numpy(), exact, strict=True):
        one, carried = session.run(None, {"landmarks": frame[None], "previous": np.zeros((1, 15), np.float32)})
        assert np.abs(one[0] - wanted).max() < 5e-3
        assert np.array_equal(one, carried.clip(0, 1))
    frames[:, 20], frames[:3, 55:58] = torch.nan, torch.nan
    missing = session.run(["weights"], {"landmarks": frames.numpy(), "previous": many})[0]
    assert np.abs(missing - solver(frames.double()).numpy()).max() < 0.05


def test_the_module_with_the_similarity_eliminated_is_the_exact_solve(examples: ExampleShapes) -> None:
    """Faces turned, moved, of another size, with noise and missing landmarks: each frame has a matrix of its own."""
    solver = ExampleSolver(examples, AllAtOnce(), SolvedSimilarity())
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(8, 15, generator=generator) * (torch.rand(8, 15, generator=generator) < 0.3)
    frames = examples.neutral + torch.einsum("pcn,bn->bpc", examples.basis, weights)
    turn = torch.tensor([[0.9, -0.3], [0.3, 0.9]])
    frames = (frames + torch.randn(frames.shape, generator=generator)) @ turn.T + 30
    frames[4:, 20], frames[6:, 50:58] = torch.nan, torch.nan
    found = PlacedExamples(solver)(frames, torch.zeros(8, 15))["weights"]
    assert (found - solver(frames.double())).abs().max() < 1e-4


@pytest.mark.bench  # torch.export takes seconds
def test_the_graph_with_the_similarity_solved_for_is_the_exact_solve(examples: ExampleShapes, tmp_path: Path) -> None:
    report = export_example_solver(ExampleSolver(examples, AllAtOnce(), SolvedSimilarity()), tmp_path / "placed.onnx")
    assert all(gap.worst < 1e-3 for gap in report.gaps)


def test_it_is_written_with_its_names_or_not_at_all(examples: ExampleShapes, tmp_path: Path) -> None:
    solver = ExampleSolver(examples)
    zoo.save_model(solver, tmp_path / "kept", zoo.ModelCard("MIT", "", {}, ""))
    again = zoo.get_model(tmp_path / "kept")
    report = export_example_solver(again, tmp_path / "solver.onnx")
    assert all(gap.mean < 5e-3 for gap in report.gaps)
    assert report.path.stat().st_size == report.size
    session = onnxruntime.InferenceSession(report.path, providers=["CPUExecutionProvider"])
    assert all(name in session.get_modelmeta().custom_metadata_map["shape_names"] for name in examples.names)
    with pytest.raises(ValueRangeError, match="take more steps"):
        export_example_solver(solver, tmp_path / "poor.onnx", steps=1, steps_at_once=1)
    with pytest.raises(ValueRangeError, match="found Regional with the similarity solved for, expected all"):
        export_example_solver(ExampleSolver(examples, Regional(), SolvedSimilarity()), tmp_path / "poor.onnx")
    with pytest.raises(ValueRangeError, match="found Distances, expected squared distances"):
        export_example_solver(ExampleSolver(examples, AllAtOnce(Distances())), tmp_path / "poor.onnx")
    assert not (tmp_path / "poor.onnx").exists()
