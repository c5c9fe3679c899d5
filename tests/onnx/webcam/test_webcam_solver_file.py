"""The webcam's solver in ONNX Runtime gives what the module gives."""

import json

import numpy as np
import onnxruntime
import pytest
import torch

from planted.webcam_solver_file import INPUTS, empty_reading, webcam_solver_model
from torchface import zoo
from torchface.capture.anybody import WebcamSettings, WebcamSolver
from torchface.capture.anybody.webcam_state import CONTROLS
from torchface.landmarks.images.face_reading import READ_FOR_SOLVER
from torchface.onnx.webcam.webcam_model import WebcamAnswer
from torchface.shape_names import ARKIT
from torchface.synthetic import performer


def parity(settings: WebcamSettings, frames: int) -> float:
    """The largest difference of an output over frames, each from the graph's own state; one shows no face."""
    rig, heads = performer(texture=False), zoo.get_model("head")
    solver = WebcamSolver(rig, heads.shape.modes[:, heads.landmarks], settings=settings)
    model = webcam_solver_model(solver)
    facts = {one.key: one.value for one in model.metadata_props}
    assert json.loads(facts["names"]) == list(ARKIT)
    assert json.loads(facts["state"]) == solver.layout.length
    assert [one.name for one in model.graph.input] == list(INPUTS)
    assert [one.name for one in model.graph.output] == list(WebcamAnswer._fields)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    generator = torch.Generator().manual_seed(2)
    rest = rig.vertices[rig.neutral.landmarks]
    state, worst, controls = torch.zeros(solver.layout.length), 0.0, torch.zeros(len(CONTROLS))
    controls[1:3] = torch.tensor([1.0, 0.5])
    for frame in range(frames):
        empty = empty_reading()
        given = {name: getattr(empty, name) for name in READ_FOR_SOLVER}
        if frame != 3:
            noise = torch.randn(68, 3, generator=generator)
            face = (rest + noise) * torch.tensor([1.0, -1.0, -1.0]) + torch.tensor([3.0 * frame, 0.0, 600.0])
            given["landmarks"] = face[:, :2] / face[:, 2:] * 554 + torch.tensor([319.5, 239.5])
            given["landmarks"][5] = torch.nan
            given["iris"] = given["landmarks"][torch.tensor([[36, 39], [42, 45]])].mean(1)
            given["openness"], given["closed"] = torch.tensor([0.3, 0.2]), torch.tensor([0.0, 0.7])
            given["expression"] = torch.rand(52, generator=generator)
            given["expression_deviation"] = torch.full((52,), 0.3)
            given |= {"visibility": torch.ones(68), "presence": torch.ones(()), "eye_visibility": torch.ones(2)}
        controls[0] = frame % 6
        given |= {"size": torch.tensor([640.0, 480.0]), "interval": torch.tensor(0.04), "controls": controls}
        given["state"] = state
        with torch.no_grad():
            expected = solver(*given.values())
        outputs = session.run(None, {name: value.numpy() for name, value in given.items()})
        named = dict(zip(WebcamAnswer._fields, outputs, strict=True))
        apart = np.abs(named["next_state"] - expected.numpy())
        worst = max(worst, float((apart / (1 + np.abs(expected.numpy()))).max()))
        np.testing.assert_array_equal(named["weights"], named["next_state"][: len(ARKIT)])
        state = torch.from_numpy(named["next_state"])
    assert float(state[: len(ARKIT)].max()) > 0.05
    return worst


@pytest.mark.bench  # torch.export takes fifteen seconds
def test_the_graph_is_the_module() -> None:
    assert parity(WebcamSettings(steps=1, coefficients=6), 4) < 1e-4


@pytest.mark.bench
def test_the_graph_of_the_default_settings_is_the_module() -> None:
    assert parity(WebcamSettings(), 40) < 1e-3
