"""A webcam's pictures one at a time through the graph that solves weights, in ONNX Runtime."""

import json
import math
from dataclasses import dataclass

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from torchface.capture.anybody import WebcamControls
from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.landmarks.images.frame_reader.face_reader import STATE
from torchface.onnx.webcam.webcam_model import OUTPUTS, WebcamGraph
from torchface.shape_names import ARKIT

SMALLEST = 64  # pixels a side of a picture, at least

_TASK = "webcam"


@dataclass(frozen=True, eq=False)
class WebcamFrame:
    """What is solved of one picture."""

    weights: Tensor  # by ARKit's 52 names, (52,) in [0,1]
    # rotation, translation: head to camera, (3,3) and (3,) millimetres
    rotation: Tensor
    translation: Tensor
    gaze: Tensor  # of the right eye and the left, (2,2) radians: to the person's left, up
    landmarks: Tensor  # iBUG's 68, (68,2) pixels; NaN without a face
    iris: Tensor  # centres of the irises, the right eye's first, (2,2) pixels; NaN without a face
    presence: float  # in [0,1]: how likely there is a face; 0 where none was found
    calibrated: float  # in [0,1]: how far the person has been learned
    # how many other people stand to the left of the face in the picture, and to the right, smoothed, (2,)
    beside: Tensor


class WebcamSession:
    """Weights, pose and gaze of whoever sits before a webcam, picture by picture, on one thread."""

    controls: WebcamControls
    """What the user asks for from the next picture on."""

    def __init__(self, model: bytes, name: str = "webcam graph") -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        # A thread that spins between frames would take a core from the application.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
            facts = self._session.get_modelmeta().custom_metadata_map
        except Exception as error:  # ONNX Runtime has no common class for what it raises
            raise FileFormatError(
                f"{name}: not an ONNX file that runs ({str(error)[:160]}), expected that of torchface export webcam"
            ) from error
        if facts.get("task") != _TASK:
            raise FileFormatError(
                f"{name}: found a graph whose task is {facts.get('task', 'not said')!r}, expected that of torchface "
                "export webcam"
            )
        self.names: tuple[str, ...] = tuple(json.loads(facts["names"]))
        self._outputs = [one.name for one in self._session.get_outputs()]
        self._start = np.zeros(int(facts["state"]), np.float32)
        self._state = self._start
        self.controls = WebcamControls()
        self._run(np.zeros((SMALLEST, SMALLEST, 3), np.uint8), 1 / 30)  # allocates: better before the first picture

    @property
    def state(self) -> Tensor:
        """What the next picture takes from those before, (S,): goes on elsewhere by ``resume``."""
        return torch.from_numpy(self._state.copy())

    def resume(self, state: Tensor) -> None:
        """Goes on from a ``state``."""
        if state.shape != self._start.shape:
            raise ShapeError(f"state: found {tuple(state.shape)}, expected {self._start.shape}")
        if not bool(torch.isfinite(state).all()):
            raise ValueRangeError("state: found a number that is not finite, expected the state of a session")
        self._state = state.detach().cpu().float().numpy().copy()

    def reset(self) -> None:
        """Forgets face and person, as before the first picture."""
        self._state = self._start

    def step(self, frame: np.ndarray | Tensor, interval: float) -> WebcamFrame:
        """What the next picture shows.

        Args:
            frame: uint8 (H,W,3) or (H,W,4), red first, as a camera or a canvas gives it; of any size from 64 pixels,
                which may change from one to the next.
            interval: seconds since the picture before.
        """
        pixels = frame.detach().cpu().numpy() if isinstance(frame, Tensor) else np.asarray(frame)
        if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
            grey = "; repeat a grey picture three times" if pixels.ndim == 2 or pixels.shape[-1:] == (1,) else ""
            raise ShapeError(
                f"frame: found {pixels.shape} {pixels.dtype}, expected (H,W,3) or (H,W,4) uint8, red first{grey}"
            )
        if min(pixels.shape[:2]) < SMALLEST:
            raise ShapeError(
                f"frame: found {pixels.shape[1]} x {pixels.shape[0]} pixels, expected {SMALLEST} a side at least"
            )
        if not (math.isfinite(interval) and interval > 0):
            raise ValueRangeError(f"interval: found {interval} seconds, expected a positive number")
        found = self._run(np.ascontiguousarray(pixels), interval)
        self._state = found["next_state"]
        tensors = {name: torch.from_numpy(found[name]) for name in _TENSORS}
        return WebcamFrame(**tensors, presence=float(found["presence"]), calibrated=float(found["calibrated"]))

    def _run(self, pixels: np.ndarray, interval: float) -> dict[str, np.ndarray]:
        inputs = {
            "image": pixels,
            "interval": np.array(interval, np.float32),
            "controls": self.controls.tensor().numpy(),
            "state": self._state,
        }
        return dict(zip(self._outputs, self._session.run(None, inputs), strict=True))


class ModuleSession(WebcamSession):
    """The same by PyTorch, in up to twice the time: it needs no graph to be made."""

    def __init__(self, module: WebcamGraph) -> None:
        self._module, self.names = module.eval(), ARKIT
        self._start = np.zeros(STATE + module.solver.state_size, np.float32)
        self._state = self._start
        self.controls = WebcamControls()
        self._run(np.zeros((SMALLEST, SMALLEST, 3), np.uint8), 1 / 30)  # as above

    def _run(self, pixels: np.ndarray, interval: float) -> dict[str, np.ndarray]:
        given = torch.from_numpy(pixels), torch.tensor(interval), self.controls.tensor(), torch.from_numpy(self._state)
        with torch.inference_mode():
            return {name: one.numpy() for name, one in zip(OUTPUTS, self._module(*given), strict=True)}


_TENSORS = ("weights", "rotation", "translation", "gaze", "landmarks", "iris", "beside")
