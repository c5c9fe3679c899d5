"""The graph of an example solver is its solve: one frame, many, and with landmarks missing."""

from dataclasses import replace
from pathlib import Path

import onnx
import onnxruntime
import pytest
import torch

from torchface import zoo
from torchface.capture import ExampleSolver
from torchface.capture.anybody import (
    AllAtOnce,
    ExampleShapes,
    LandmarkBoxes,
    LandmarkModel,
    Regional,
    SolvedSimilarity,
    paper_examples,
)
from torchface.errors import ValueRangeError
from torchface.onnx import example_graph_export, export_example_solver
from torchface.onnx.example_graph import ExampleGraph
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def examples() -> ExampleShapes:
    return paper_examples(performer(texture=False))


@pytest.mark.parametrize("kind", ["all", "regional", "model", "placed", "placed regions", "placed model"])
def test_the_module_is_the_exact_solve(examples: ExampleShapes, kind: str) -> None:
    """Faces of other proportions, turned where that is solved for, with noise and missing landmarks."""
    method, placement = {
        "all": (AllAtOnce(), LandmarkBoxes()),
        "regional": (Regional(), LandmarkBoxes()),
        "model": (LandmarkModel.fit(examples, variance=0.999), LandmarkBoxes()),
        "placed": (AllAtOnce(), SolvedSimilarity()),
        "placed regions": (Regional(), SolvedSimilarity()),
        "placed model": (LandmarkModel.fit(examples, variance=0.999), SolvedSimilarity()),
    }[kind]
    solver = ExampleSolver(examples, method, placement)
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(8, 15, generator=generator) * (torch.rand(8, 15, generator=generator) < 0.3)
    frames = examples.neutral + torch.einsum("pcn,bn->bpc", examples.basis, weights)
    turn = torch.tensor([[0.9, -0.3], [0.3, 0.9]]) if "placed" in kind else torch.diag(torch.tensor([1.4, 0.9]))
    frames = (frames + torch.randn(frames.shape, generator=generator)) @ turn.T + 30
    frames[4:, 20], frames[6:, 50:58] = torch.nan, torch.nan
    found = ExampleGraph(solver)(frames, torch.zeros(8, 15))["weights"]
    assert (found - solver(frames.double())).abs().max() < 1e-4


@pytest.mark.bench  # torch.export takes seconds
@pytest.mark.parametrize(
    "method",
    [Regional(), LandmarkModel, SolvedSimilarity()],
    ids=lambda one: getattr(one, "__name__", type(one).__name__),
)
def test_the_graph_is_the_exact_solve(examples: ExampleShapes, method: object, tmp_path: Path) -> None:
    if isinstance(method, SolvedSimilarity):
        solver = ExampleSolver(examples, AllAtOnce(), method)
    else:
        solver = ExampleSolver(examples, method if isinstance(method, Regional) else LandmarkModel.fit(examples))
    report = export_example_solver(solver, tmp_path / "solver.onnx")
    assert all(gap.worst < 1e-3 for gap in report.gaps)
    session = onnxruntime.InferenceSession(report.path, providers=["CPUExecutionProvider"])
    assert [one.name for one in session.get_outputs()] == ["weights", "carried"]


@pytest.mark.bench  # torch.export takes ten seconds
def test_it_is_written_with_its_names_or_not_at_all(
    examples: ExampleShapes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solver = ExampleSolver(examples)
    zoo.save_model(solver, tmp_path / "kept", zoo.ModelCard("MIT", "", {}, ""))
    again = zoo.get_model(tmp_path / "kept")
    report = export_example_solver(again, tmp_path / "solver.onnx")
    assert all(gap.mean < 1e-4 for gap in report.gaps), report
    assert report.path.stat().st_size == report.size
    session = onnxruntime.InferenceSession(report.path, providers=["CPUExecutionProvider"])
    assert all(name in session.get_modelmeta().custom_metadata_map["shape_names"] for name in examples.names)
    monkeypatch.setattr(example_graph_export, "example_model", lambda *_: onnx.load(report.path))
    with pytest.raises(ValueRangeError, match="take more steps"):  # the graph of other examples
        export_example_solver(
            ExampleSolver(replace(examples, landmarks=1.2 * examples.landmarks)), tmp_path / "poor.onnx"
        )
    monkeypatch.undo()
    assert not (tmp_path / "poor.onnx").exists()
