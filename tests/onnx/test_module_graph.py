"""Modules of tensors as ONNX: what ONNX Runtime computes is what PyTorch does, at any batch size."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnxruntime
import pytest
import torch
from scipy.optimize import lsq_linear
from torch import Tensor, nn

from torchface import zoo
from torchface.errors import ShapeError, TraceError, ValueRangeError
from torchface.onnx import export_model, export_module
from torchface.onnx.module_graph import export_shape_prior
from torchface.optim import BoxQP, ProjectedGradient, box_qp

ROOT = torch.tensor([[1.0, 0.3, 0.0], [0.2, 1.0, 0.1], [0.0, 0.4, 1.0], [0.1, 0.0, 0.2]])


class Found(NamedTuple):
    weights: Tensor
    doubled: Tensor


class Network(nn.Module):
    """A solve for the weights of a basis; an attribute has a name that ``torch.export`` uses itself."""

    def __init__(self) -> None:
        super().__init__()
        self.graph = nn.Linear(4, 4, bias=False)
        nn.init.eye_(self.graph.weight)
        self.program = ProjectedGradient(ROOT.T @ ROOT, steps=200)

    def forward(self, target: Tensor) -> Found:
        weights = self.program(-self.graph(target) @ ROOT)
        return Found(weights, 2 * weights)


def test_a_network_with_a_solve_in_it_runs_in_onnx_runtime_as_scipy_solves(tmp_path: Path) -> None:
    targets = torch.randn(5, 4, generator=torch.Generator().manual_seed(0))
    report = export_module(Network(), {"target": targets[:2]}, tmp_path / "solve.onnx", {"licence": "MIT"})
    session = onnxruntime.InferenceSession(report.path)
    assert [output.name for output in session.get_outputs()] == ["weights", "doubled"]
    assert session.get_modelmeta().custom_metadata_map["licence"] == "MIT"
    weights, doubled = session.run(None, {"target": targets.numpy()})
    exact = [lsq_linear(ROOT.double().numpy(), row, (0, 1), tol=1e-14).x for row in targets.double().numpy()]
    np.testing.assert_allclose(weights, exact, atol=1e-4)
    np.testing.assert_allclose(doubled, 2 * weights)


class Exact(nn.Module):
    def __init__(self, module: bool) -> None:
        super().__init__()
        self.H, self.qp = torch.eye(2), BoxQP(torch.eye(2)) if module else None

    def forward(self, f: Tensor) -> Tensor:
        return box_qp(self.H, f) if self.qp is None else self.qp(f)


@pytest.mark.parametrize("module", [True, False])
def test_what_iterates_until_it_is_solved_names_the_layer_that_exports(tmp_path: Path, module: bool) -> None:
    with pytest.raises(TraceError, match=r"iterates until .* expected torchface\.optim\.ProjectedGradient"):
        export_module(Exact(module), {"f": torch.rand(2, 2)}, tmp_path / "qp.onnx")
    assert not list(tmp_path.iterdir())


class Rounded(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return (x - x) / 0


def test_what_is_no_number_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueRangeError, match="ONNX Runtime's output differ from PyTorch's by inf"):
        export_module(Rounded(), {"x": torch.ones(2, 1)}, tmp_path / "x.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shapes", [(), ((1, 3),), ((2, 3), (4, 3)), ((),)])
def test_examples_are_two_rows_or_more(tmp_path: Path, shapes: tuple[tuple[int, ...], ...]) -> None:
    given = {str(number): torch.zeros(shape) for number, shape in enumerate(shapes)}
    with pytest.raises(ShapeError, match="same two rows or more"):
        export_module(Network(), given, tmp_path / "x.onnx")


def test_a_shape_prior_gives_its_log_density(tmp_path: Path) -> None:
    prior = zoo.get_model("shape_prior")
    report = export_shape_prior(prior.float(), tmp_path / "prior.onnx")
    weights = torch.rand(7, len(prior.names), generator=torch.Generator().manual_seed(1))
    (found,) = onnxruntime.InferenceSession(report.path).run(None, {"weights": weights.numpy()})
    expected = prior.double().log_density(weights.double()).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3)


class Gain(nn.Module):
    def __init__(self, count: int) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.arange(1.0, count + 1))

    @property
    def config(self) -> dict[str, int]:
        return {"count": len(self.gain)}

    @classmethod
    def from_config(cls, config: dict[str, int]) -> "Gain":
        return cls(config["count"])

    def forward(self, x: Tensor) -> Tensor:
        return self.gain * x

    def example_inputs(self) -> dict[str, Tensor]:
        return {"x": torch.ones(2, len(self.gain))}


def test_a_kind_of_ones_own_is_saved_loaded_and_exported(tmp_path: Path) -> None:
    try:
        zoo.register("test_gain", Gain)
        zoo.register("test_gain", Gain)  # twice is once
        zoo.save_model(Gain(3), tmp_path / "mine", zoo.ModelCard("MIT", "none", {}, "by hand"))
        loaded = zoo.get_model(tmp_path / "mine", Gain)
        report = export_model(loaded, tmp_path / "mine.onnx")
        (found,) = onnxruntime.InferenceSession(report.path).run(None, {"x": np.full((4, 3), 2.0, np.float32)})
        np.testing.assert_array_equal(found, np.tile([2.0, 4.0, 6.0], (4, 1)))
    finally:
        zoo.KINDS.pop("test_gain", None)
