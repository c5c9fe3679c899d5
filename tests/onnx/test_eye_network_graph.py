"""The eye network as ONNX: as in PyTorch, small, and quick to make."""

from pathlib import Path

import torch

from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.onnx.eye_network_graph import export_eye_network


def test_the_graph_finds_what_the_network_finds(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = EyeNetwork()
    for module in network.modules():  # statistics and heads as after training, not as at birth
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.2)  # type: ignore[union-attr, operator]
            module.running_var.uniform_(0.5, 2)  # type: ignore[union-attr, operator]
    torch.nn.init.normal_(network.local, 0, 0.3)
    report = export_eye_network(network, tmp_path / "eyes.onnx")
    assert set(report.parity) == {"landmarks", "iris", "deviation", "openness", "closed", "visibility"}
    assert (tmp_path / "eyes.onnx").stat().st_size < 165_000
