"""Wrinkle weights as ONNX against PyTorch."""

import json
from pathlib import Path

import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor

from torchface import BlendshapeRig, Corrective, Correctives, Mesh
from torchface.enhancement.wrinkle_maps.wrinkle_weights import RigWrinkles, WrinkleWeights
from torchface.geometry.rotations import rotation_matrix
from torchface.onnx import export_wrinkle_weights

NAMES = ("first", "second", "third")


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    """A bent sheet of 400 points with three broad shapes, a combination, and an in-between listed before it."""
    x, y = torch.meshgrid(torch.linspace(-60, 60, 20), torch.linspace(-80, 80, 20), indexing="ij")
    points = torch.stack([x, y, 60 - 0.01 * x.square()], dim=-1).view(-1, 3)
    faces = torch.tensor([[0, 1, 20], [1, 21, 20]])
    bumps = torch.stack([(-(points[:, 1] - place).square() / 900).exp() for place in (-50.0, 0.0, 50.0)])
    deltas = 8 * bumps[..., None] * torch.randn(3, 1, 3, generator=torch.Generator().manual_seed(0))
    correctives = Correctives(
        deltas[[2, 0]] * 0.5, (Corrective("half", ("second",), peak=0.4), Corrective("both", ("first", "third")))
    )
    return BlendshapeRig(Mesh(points, faces), deltas, NAMES, correctives)


@pytest.fixture(scope="module")
def poses() -> Tensor:
    return torch.rand(30, 3, generator=torch.Generator().manual_seed(1))


@pytest.fixture(scope="module")
def learned(rig: BlendshapeRig, poses: Tensor) -> WrinkleWeights:
    shares = torch.softmax(rig.vertices[:, 1] * torch.tensor([[-0.1], [0.1]]), dim=0)
    weights = torch.stack([poses[:, :2], poses[:, 1:]], dim=1)
    return WrinkleWeights.fit(rig.vertices, rig(poses), weights, shares, ("low", "high"), components=5)


def run(path: Path, inputs: Tensor) -> Tensor:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    found = session.run(["map_weights"], {session.get_inputs()[0].name: inputs.numpy()})
    return torch.from_numpy(found[0])


@pytest.mark.bench  # tests/modules exports the module to a graph of PyTorch's
def test_the_graph_of_vertices_is_the_module(
    rig: BlendshapeRig, learned: WrinkleWeights, poses: Tensor, tmp_path: Path
) -> None:
    report = export_wrinkle_weights(learned, rig(poses), tmp_path / "v.onnx", {"maps": ["a", "b"]})
    assert report.parity["map_weights"] <= 1e-4
    turned = rig(poses[:4]) @ rotation_matrix(torch.tensor([0.3, 1.2, -0.4])).T + 500.0
    for vertices in (turned, turned[:1]):
        torch.testing.assert_close(run(report.path, vertices), learned(vertices), atol=1e-3, rtol=0)
    told = {entry.key: entry.value for entry in onnx.load(report.path).metadata_props}
    assert json.loads(told["regions"]) == ["low", "high"]
    assert json.loads(told["maps"]) == ["a", "b"]


@pytest.mark.bench
def test_the_graph_of_blendshape_weights_gives_what_the_posed_rig_does(
    rig: BlendshapeRig, learned: WrinkleWeights, poses: Tensor, tmp_path: Path
) -> None:
    export_wrinkle_weights(RigWrinkles(learned, rig), poses, tmp_path / "w.onnx")
    for some in (poses, poses[3:4]):
        torch.testing.assert_close(run(tmp_path / "w.onnx", some), learned(rig(some)), atol=5e-4, rtol=0)
    bare = RigWrinkles(learned, rig.without_correctives())(poses)
    torch.testing.assert_close(bare, learned(rig.without_correctives()(poses)), atol=5e-4, rtol=0)
    assert not torch.allclose(bare, run(tmp_path / "w.onnx", poses), atol=0.05)
