"""A webcam's graph whose solver is planted, and a face to show it."""

from __future__ import annotations

import pytest
import torch
from onnx import ModelProto
from torch import Tensor

from torchface import zoo
from torchface.geometry.cameras.pinhole import look_at
from torchface.onnx.graph_values import OPSET, Value, ValueGraph
from torchface.onnx.webcam.face_reader import WebcamNetworks
from torchface.onnx.webcam.webcam_model import webcam_model
from torchface.rendering.clay_shading import Lighting, render
from torchface.shape_names import ARKIT
from torchface.synthetic import performer


@pytest.fixture(scope="session")
def portrait() -> tuple[Tensor, Tensor]:
    """A performer's head on grey, (3,150,150), and its landmarks (68,2)."""
    rig = performer()
    marks = rig.neutral.landmarks
    camera = look_at(rig.vertices[marks].double().mean(0), 0.0, 0.0, 330.0, 150, 150)
    picture = render(rig.neutral, camera, background=(0.3, 0.35, 0.4), lighting=Lighting(occlusion_rays=0), samples=1)
    return (picture.clamp(0, 1) * 255).byte(), camera.project(rig.vertices[marks].double()).float()


@pytest.fixture(scope="session")
def networks() -> WebcamNetworks:
    """The zoo's."""
    return WebcamNetworks(*(zoo.get_model(name) for name in ("face_boxes", "landmark_network", "eye_network")))


@pytest.fixture(scope="session")
def webcam_file(networks: WebcamNetworks) -> bytes:
    """The graph with a planted solver."""
    return webcam_model(networks, planted_solver(), facts={"licence": "MIT"}).SerializeToString()


def planted_solver() -> ModelProto:
    """A solver that counts frames and gives the first weight what the landmarks' mean column is."""
    graph = ValueGraph()
    state = graph.value("state")
    column = graph.value("landmarks").rows(0, 1, axis=1).reduced("ReduceMean", 0)
    weights = graph.either(  # a branch that uses constants from outside
        graph.value("interval").shaped(1) > 0.0,
        lambda: graph.cat(column, torch.zeros(len(ARKIT) - 1)),
        lambda: graph.as_value(torch.zeros(len(ARKIT))),
    )
    outputs: dict[str, tuple[Value, tuple[int, ...]]] = {
        "weights": (weights, (len(ARKIT),)),
        "rotation": (graph.as_value(torch.eye(3)), (3, 3)),
        "translation": (graph.value("controls").rows(0, 3), (3,)),
        "gaze": (graph.as_value(torch.zeros(2, 2)), (2, 2)),
        "calibrated": (graph.value("interval"), ()),
        "next_state": (state + 1.0, (2,)),
    }
    for name, (value, _) in outputs.items():
        graph.build.op("Identity", value.name, output=name)
    inputs = {"landmarks": (68, 2), "controls": (5,), "interval": (), "state": (2,)}
    return graph.root.model("planted", inputs, {name: shape for name, (_, shape) in outputs.items()}, {}, OPSET)
