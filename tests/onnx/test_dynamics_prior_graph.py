"""A dynamics prior as ONNX says what the module says, and refuses a graph that does not."""

import json

import numpy as np
import onnxruntime
import pytest
import torch

from torchface.capture import DynamicsPrior, DynamicsSettings
from torchface.onnx import ExportReport, export_model
from torchface.synthetic.stages import perform


@pytest.fixture(scope="module", params=[1, 4])
def prior(request: pytest.FixtureRequest) -> DynamicsPrior:
    takes = []
    for seed in range(2):
        track = perform(240, torch.Generator().manual_seed(seed)).weights
        takes.append(track.values[..., 0])
    settings = DynamicsSettings(inducing=30, subset=200, iterations=5)
    return DynamicsPrior.fit(takes, track.names, request.param, input_noise=0.01, settings=settings)


@pytest.fixture(scope="module")
def report(prior: DynamicsPrior, tmp_path_factory: pytest.TempPathFactory) -> ExportReport:
    report = export_model(prior, tmp_path_factory.mktemp("graph") / "prior.onnx", {"licence": "MIT"})
    assert isinstance(report, ExportReport)
    return report


@pytest.mark.bench
def test_the_graph_predicts_as_the_module(prior: DynamicsPrior, report: ExportReport) -> None:
    assert "ONNX Runtime against PyTorch" in str(report)
    session = onnxruntime.InferenceSession(report.path, providers=["CPUExecutionProvider"])
    track = perform(300, torch.Generator().manual_seed(9)).weights
    windows = track.values[..., 0].unfold(0, prior.window, 1).transpose(1, 2).contiguous()
    mean, deviation = session.run(["mean", "deviation"], {"windows": windows.numpy()})
    expected, variance = prior(windows)
    np.testing.assert_allclose(mean, expected.numpy(), atol=1e-5)
    np.testing.assert_allclose(deviation, variance.sqrt().numpy(), rtol=1e-3, atol=1e-6)
    facts = session.get_modelmeta().custom_metadata_map
    assert json.loads(facts["shape_names"]) == list(prior.names)
    assert json.loads(facts["window"]) == prior.window
    assert json.loads(facts["fps"]) == prior.fps
    assert json.loads(facts["input_noise"]) == prior.input_noise
