"""Landmarks by MediaPipe's face mesh, in a Python of its own: its wheel and torchface's packages exclude each other."""

from __future__ import annotations

import importlib.util
import os
import struct
import subprocess
import sys
import tempfile
import threading
import weakref
from contextlib import suppress
from pathlib import Path
from typing import IO

import numpy as np
import torch
from torch import Tensor

from torchface.errors import MissingExtraError, TorchfaceError
from torchface.landmarks.images.face_crop import crop_transform, cut_crop, from_crop
from torchface.landmarks.images.face_mesh_478 import MESH_POINTS, landmarks_of_mesh
from torchface.landmarks.images.face_reading import FaceReading, box_side
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.networks import mediapipe_process

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

    Raises:
        MissingExtraError: there is none; the message says how to install it.
        MediaPipeError: it could not be started.
    """

    name = "mediapipe"

    def __init__(self, python: str | Path | None = None) -> None:
        self.python = _python(python)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  lives as long as the process that writes it
        script = str(Path(mediapipe_process.__file__).resolve())
        environment = {**os.environ, "GLOG_minloglevel": "3", "TF_CPP_MIN_LOG_LEVEL": "3"}
        try:
            self._process = subprocess.Popen(
                [str(self.python), "-I", script],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=environment,
            )
        except OSError as error:
            raise MissingExtraError(f"{self.python}: cannot be run ({error}); {_how()}") from error
        self._end = weakref.finalize(self, _stop, self._process, self._errors)
        try:
            self._answer(_START_SECONDS)
        except MediaPipeError as error:
            self._end()
            raise MissingExtraError(f"{error}; {_how()}") from error

    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        """See :class:`~torchface.landmarks.images.landmark_finder.LandmarkFinder`."""
        transform = crop_transform(box, tilt, _SIZE, _MARGIN)
        crop = np.ascontiguousarray(cut_crop(image, transform, _SIZE).permute(1, 2, 0).numpy())
        try:
            self._pipe(self._process.stdin).write(struct.pack("<II", _SIZE, _SIZE) + crop.tobytes())
            self._pipe(self._process.stdin).flush()
        except OSError as error:
            raise self._failed("has ended") from error
        points = self._answer(_ANSWER_SECONDS)
        nothing = torch.zeros(COUNT)
        if not len(points):
            middle = (box[:2] + box[2:] / 2).float().expand(COUNT, 2).clone()
            return FaceReading(middle, nothing + torch.inf, nothing, torch.zeros(()), search_box=box)
        landmarks = from_crop(landmarks_of_mesh(points) * _SIZE - 0.5, transform)
        deviation = nothing + _DEVIATION * box_side(box)
        return FaceReading(landmarks, deviation, torch.ones(COUNT), torch.ones(()), search_box=box)

    def close(self) -> None:
        """Ends the process."""
        self._end()

    def _answer(self, seconds: float) -> Tensor:
        """The next points (478,2) or (0,2), in shares of the crop."""
        late = threading.Timer(seconds, self._process.kill)
        late.daemon = True
        late.start()
        try:
            head = self._read(4)
            count = struct.unpack("<I", head)[0] if len(head) == 4 else None
            if count not in (0, MESH_POINTS):
                what = f"gave {count} points, expected {MESH_POINTS}" if count is not None else "has ended"
                raise self._failed(what if late.is_alive() else f"gave no answer in {seconds:g} seconds")
            content = self._read(8 * count)
            if len(content) < 8 * count:
                raise self._failed("has ended in the midst of an answer")
        finally:
            late.cancel()
        return torch.from_numpy(np.frombuffer(content, "<f4").astype(np.float32).reshape(-1, 2))

    def _read(self, count: int) -> bytes:
        return self._pipe(self._process.stdout).read(count)

    def _pipe(self, pipe: IO[bytes] | None) -> IO[bytes]:
        if pipe is None or pipe.closed:
            raise self._failed("was closed")
        return pipe

    def _failed(self, what: str) -> MediaPipeError:
        said = ""
        if not self._errors.closed:
            self._errors.seek(max(0, self._errors.seek(0, os.SEEK_END) - 4096))
            lines = self._errors.read().decode("utf-8", "replace").strip().splitlines()
            said = f": {lines[-1].strip()[:200]}" if lines else ""
        return MediaPipeError(f"mediapipe: its process under {self.python} {what}{said}")


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


def _stop(process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
    """Ends the process: what comes in ends, and if that is not enough it is killed."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):  # it has ended before what was written was read
                pipe.close()
    try:
        process.wait(2)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    errors.close()
