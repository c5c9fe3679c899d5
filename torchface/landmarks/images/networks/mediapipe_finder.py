"""Landmarks by MediaPipe's face mesh, in a Python of its own: its wheel and torchface's packages exclude each other."""

from __future__ import annotations

import importlib.util
import os
import struct
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.errors import MissingExtraError, TorchfaceError
from torchface.landmarks.images.face_crop import crop_transform, cut_crop, from_crop
from torchface.landmarks.images.face_mesh_478 import MESH_POINTS, landmarks_of_mesh
from torchface.landmarks.images.face_reading import FaceReading, box_side
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.networks import mediapipe_process
from torchface.landmarks.images.networks.answering_process import AnsweringProcess

PYTHON = "TORCHFACE_MEDIAPIPE_PYTHON"
"""The environment variable that names the Python with MediaPipe."""

_SIZE, _MARGIN = 224, 1.8
_DEVIATION = 0.01  # of the box's side; MediaPipe gives none of its own
_START_SECONDS, _ANSWER_SECONDS = 120.0, 30.0
_INSTALL = (
    "python3.11 -m venv ~/mediapipe && ~/mediapipe/bin/pip install --no-deps mediapipe==0.10.14 && "
    "~/mediapipe/bin/pip install absl-py attrs flatbuffers matplotlib 'numpy<2' 'protobuf<5' "
    "opencv-contrib-python-headless, then export "
    f"{PYTHON}=~/mediapipe/bin/python"
)


class MediaPipeError(TorchfaceError):
    """The process that runs MediaPipe failed."""


class MediaPipeFinder:
    """Finds landmarks by MediaPipe's refined face mesh, version 0.10.14, whose wheel holds its models.

    Each face is shown to it upright and at one size, every frame for itself, so that its answer depends on nothing
    else. It gives no deviation and no visibility: every landmark has the confidence 0.8 and is visible; the presence is
    1 where it sees a face and 0 where it does not. It runs in another process, which ends with this one.

    Args:
        python: the Python that has the package; what the environment variable ``TORCHFACE_MEDIAPIPE_PYTHON`` names, or
            the running one, if absent.
    """

    name = "mediapipe"

    def __init__(self, python: str | Path | None = None) -> None:
        self.python = _python(python)
        script = str(Path(mediapipe_process.__file__).resolve())
        environment = {**os.environ, "GLOG_minloglevel": "3", "TF_CPP_MIN_LOG_LEVEL": "3"}
        name = f"mediapipe: its process under {self.python}"
        try:
            command = [str(self.python), "-I", script]
            self._process = AnsweringProcess(command, name, MediaPipeError, environment)
        except OSError as error:
            raise MissingExtraError(f"{self.python}: cannot be run ({error}); {_how()}") from error
        try:
            with self._process.within(_START_SECONDS):
                self._answer()
        except MediaPipeError as error:
            self.close()
            raise MissingExtraError(f"{error}; {_how()}") from error

    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        """See :class:`~torchface.landmarks.images.landmark_finder.LandmarkFinder`."""
        transform = crop_transform(box, tilt, _SIZE, _MARGIN)
        crop = np.ascontiguousarray(cut_crop(image, transform, _SIZE).permute(1, 2, 0).numpy())
        with self._process.within(_ANSWER_SECONDS):
            self._process.send(struct.pack("<II", _SIZE, _SIZE) + crop.tobytes())
            points = self._answer()
        nothing = torch.zeros(COUNT)
        if not len(points):
            middle = (box[:2] + box[2:] / 2).float().expand(COUNT, 2).clone()
            return FaceReading(middle, nothing + torch.inf, nothing, torch.zeros(()), search_box=box)
        landmarks = from_crop(landmarks_of_mesh(points) * _SIZE - 0.5, transform)
        deviation = nothing + _DEVIATION * box_side(box)
        return FaceReading(landmarks, deviation, torch.ones(COUNT), torch.ones(()), search_box=box)

    def close(self) -> None:
        """Ends the process."""
        self._process.close()

    def _answer(self) -> Tensor:
        """The next points (478,2) or (0,2), in shares of the crop."""
        (count,) = struct.unpack("<I", self._process.receive(4, "has ended"))
        if count not in (0, MESH_POINTS):
            raise self._process.failed(f"gave {count} points, expected {MESH_POINTS}")
        content = self._process.receive(8 * count)
        return torch.from_numpy(np.frombuffer(content, "<f4").astype(np.float32).reshape(-1, 2))


def _python(python: str | Path | None) -> Path:
    named = python or os.environ.get(PYTHON)
    if named:
        path = Path(named).expanduser()
        if not path.is_file():
            raise MissingExtraError(f"{path}: found no such file, expected the Python that has MediaPipe; {_how()}")
        return path
    if importlib.util.find_spec("mediapipe") is None:
        raise MissingExtraError(f"landmarks by mediapipe: found no Python that has it, expected one; {_how()}")
    return Path(sys.executable)


def _how() -> str:
    return f"install it beside torchface with: {_INSTALL}"
