"""ONNX Runtime's own format says and computes what the ONNX file does."""

import numpy as np
import onnxruntime
import torch
from torch import nn

from torchface.onnx.exported_model import exported_model
from torchface.onnx.runtime_format import in_runtime_format


def test_the_format_keeps_results_and_what_the_file_says_of_itself() -> None:
    network = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 2))
    model = exported_model(network, {"x": torch.zeros(1, 3)}, ["y"], {"task": "webcam"}).SerializeToString()
    saved, _ = in_runtime_format(model)
    assert saved[4:8] == b"ORTM"
    session = onnxruntime.InferenceSession(saved, providers=["CPUExecutionProvider"])
    x = np.array([[1.0, -2.0, 3.0]], np.float32)
    (y,) = session.run(None, {"x": x})
    np.testing.assert_allclose(y, network(torch.from_numpy(x)).detach().numpy(), atol=1e-6)
    assert session.get_modelmeta().custom_metadata_map["task"] == "webcam"
