"""The graph of the network of face boxes gives what the network gives, for images of every size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from torchface.landmarks import BoxNetwork
from torchface.onnx import export_model
from torchface.onnx.face_box_graph import FACE_VALUES


@pytest.fixture(scope="module")
def network() -> BoxNetwork:
    """A small one that has seen noise, with weights as large as learned ones, so that its scores differ."""
    with torch.random.fork_rng([]):
        torch.manual_seed(3)
        drawn = BoxNetwork((8, 8, 12, 12), (1, 1, 1, 1), faces=8)
        with torch.no_grad():
            drawn.said.weight.normal_()
            for _ in range(30):  # batch normalisation learns what comes
                drawn.train()(torch.rand(2, 3, 96, 96))
    return drawn.eval()


def test_other_sizes_than_it_was_exported_with(network: BoxNetwork, tmp_path: Path) -> None:
    path = tmp_path / "boxes.onnx"
    export_model(network, path, {"licence": "MIT"})
    session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    for batch, height, width in ((1, 96, 224), (3, 160, 64)):
        images = torch.rand(batch, 3, height, width, generator=torch.Generator().manual_seed(height))
        (found,) = session.run(["faces"], {"images": images.numpy()})
        with torch.no_grad():
            expected = network(images).numpy()
        assert expected[:, 0, 3].min() > 1.5 * expected[:, -1, 3].max()  # there is something to tell apart
        np.testing.assert_allclose(found, expected, atol=2e-3)
    facts = {one.key: one.value for one in onnx.load(path).metadata_props}
    assert facts["task"] == "face_boxes"
    assert facts["values"] == str(list(FACE_VALUES)).replace("'", '"')
    assert facts["licence"] == "MIT"
