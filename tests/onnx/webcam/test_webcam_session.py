"""Pictures one at a time: what a session hands on, and what it refuses."""

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from torchface.capture.anybody import WebcamControls
from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.onnx.webcam.webcam_model import WebcamGraph
from torchface.onnx.webcam.webcam_session import ModuleSession, WebcamSession
from torchface.shape_names import ARKIT


@pytest.fixture(scope="module")
def session(webcam_file: bytes) -> WebcamSession:
    return WebcamSession(webcam_file)


@pytest.fixture
def frame() -> np.ndarray:
    return np.full((150, 150, 3), 240, np.uint8)


def test_a_session_goes_on_where_another_was(session: WebcamSession, frame: np.ndarray, webcam_file: bytes) -> None:
    session.reset()
    assert session.names == ARKIT
    first = session.step(frame, 1 / 30)
    assert first.presence > 0.9
    kept = session.state
    session.controls = WebcamControls(pose=3, gain=2.0)
    second = session.step(np.concatenate([frame, frame[..., :1]], -1), 1 / 60)
    session.controls = WebcamControls()
    assert second.translation.tolist() == [3.0, 2.0, 0.5]
    assert second.calibrated == pytest.approx(1 / 60)
    assert float(session.state[-1]) == 2  # the planted solver counts
    other = WebcamSession(webcam_file)
    other.resume(kept)
    again = other.step(torch.from_numpy(frame), 1 / 60)
    assert torch.equal(again.landmarks, second.landmarks)
    other.reset()
    assert float(other.state.abs().sum()) == 0


def test_pytorch_answers_as_the_graph_does_and_hands_its_state_over(
    session: WebcamSession, frame: np.ndarray, webcam_module: WebcamGraph
) -> None:
    by_module = ModuleSession(webcam_module)
    session.reset()
    for controls in (WebcamControls(), WebcamControls(pose=3, gain=2.0)):
        by_module.controls = session.controls = controls
        found, expected = by_module.step(frame, 1 / 60), session.step(frame, 1 / 60)
        for name in ("weights", "rotation", "translation", "gaze", "landmarks", "iris", "beside"):
            torch.testing.assert_close(getattr(found, name), getattr(expected, name), msg=name)
        assert (found.presence, found.calibrated) == pytest.approx((expected.presence, expected.calibrated))
    torch.testing.assert_close(by_module.state, session.state)
    session.reset()
    session.resume(by_module.state)
    session.step(frame, 1 / 60)
    session.controls = WebcamControls()
    assert float(session.state[-1]) == 3  # the planted solver counts


def test_a_camera_may_change_its_size(session: WebcamSession, frame: np.ndarray) -> None:
    session.reset()
    large = np.kron(frame, np.ones((2, 2, 1), np.uint8))
    before, after = session.step(frame, 1 / 30), session.step(large, 10.0)
    assert float((after.landmarks - (2 * before.landmarks + 0.5)).norm(dim=1).mean()) < 3


def test_what_is_no_picture_is_refused(session: WebcamSession, frame: np.ndarray) -> None:
    before = session.state
    with pytest.raises(ShapeError, match=r"\(150, 150\) uint8, expected .* repeat a grey picture three times"):
        session.step(frame[..., 0], 1 / 30)
    with pytest.raises(ShapeError, match="float32, expected"):
        session.step(frame.astype(np.float32), 1 / 30)
    with pytest.raises(ShapeError, match="found 150 x 60 pixels, expected 64 a side"):
        session.step(frame[:60], 1 / 30)
    for interval in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueRangeError, match="interval: found"):
            session.step(frame, interval)
    with pytest.raises(ShapeError, match="state: found"):
        session.resume(before[:-1])
    with pytest.raises(ValueRangeError, match="not finite"):
        session.resume(torch.full_like(before, torch.nan))
    assert torch.equal(session.state, before)


def test_another_file_is_refused(webcam_file: bytes) -> None:
    with pytest.raises(FileFormatError, match=r"my\.onnx: not an ONNX file that runs"):
        WebcamSession(webcam_file[: len(webcam_file) // 2], "my.onnx")
    value = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])
    node = helper.make_node("Identity", ["x"], ["y"])
    end = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1])
    other = helper.make_model(
        helper.make_graph([node], "g", [value], [end]), opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8
    )
    with pytest.raises(FileFormatError, match="whose task is 'not said', expected that of torchface export webcam"):
        WebcamSession(other.SerializeToString(), "my.onnx")
