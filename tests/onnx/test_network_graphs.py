"""Graphs of the networks that read images give what the networks give; face boxes for images of every size."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from torchface import zoo
from torchface.landmarks import BoxNetwork, EyeNetwork
from torchface.onnx import export_model, network_graphs
from torchface.onnx.network_graphs import FACE_VALUES
from torchface.workflows import named_finders


@pytest.fixture(scope="module")
def network() -> BoxNetwork:
    """A small one that has seen noise, with weights as large as learned ones, so that its scores differ."""
    with torch.random.fork_rng([]):
        torch.manual_seed(3)
        drawn = BoxNetwork((8, 8, 12, 12), (1, 1, 1, 1), faces=8)
        with torch.no_grad():
            drawn.said.weight.normal_(0, 0.2)
            for _ in range(30):  # batch normalisation learns what comes
                drawn.train()(torch.rand(2, 3, 96, 96))
    return drawn.eval()


@pytest.mark.bench  # torch.export takes ten seconds
def test_other_sizes_than_it_was_exported_with(network: BoxNetwork, tmp_path: Path) -> None:
    path = tmp_path / "boxes.onnx"
    export_model(network, path, {"licence": "MIT"})
    session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    for batch, height, width in ((1, 96, 224), (3, 160, 64)):
        images = torch.rand(batch, 3, height, width, generator=torch.Generator().manual_seed(height))
        (found,) = session.run(["faces"], {"images": images.numpy()})
        with torch.no_grad():
            expected = network(images).numpy()
        assert (expected[:, 0, 3] > 1.5 * expected[:, -1, 3]).all()  # there is something to tell apart
        np.testing.assert_allclose(found, expected, atol=2e-3, rtol=1e-5)  # sides of thousands of pixels
    facts = {one.key: one.value for one in onnx.load(path).metadata_props}
    assert facts["task"] == "face_boxes"
    assert facts["values"] == str(list(FACE_VALUES)).replace("'", '"')
    assert facts["licence"] == "MIT"


def test_the_landmark_network_of_the_zoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its graph is within a tenth of a pixel and a fiftieth of a deviation, in half precision."""
    network = zoo.get_model("landmark_network")
    kept = onnx.ModelProto.FromString(named_finders._graph(network))  # which other tests run, made anew by other code
    monkeypatch.setattr(network_graphs, "network_model", lambda *_: kept)
    report = export_model(network, tmp_path / "landmarks.onnx")
    assert report.parity["landmarks"] < 0.1
    assert report.parity["point_deviation"] < 0.02


@pytest.mark.bench  # tests/modules exports the module to a graph of PyTorch's
def test_eyes_in_a_small_file(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = EyeNetwork()
    for module in network.modules():  # statistics and heads as after training, not as initialised
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.2)
            module.running_var.uniform_(0.5, 2)
    torch.nn.init.normal_(network.local, 0, 0.3)
    report = export_model(network, tmp_path / "eyes.onnx")
    assert set(report.parity) == {"landmarks", "iris", "deviation", "openness", "closed", "visibility"}
    assert (tmp_path / "eyes.onnx").stat().st_size < 165_000
