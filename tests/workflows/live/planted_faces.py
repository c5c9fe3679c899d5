"""A film whose shades are weights, a solver that reads them, and who asks a session for them."""

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchface.capture.anybody import WebcamControls
from torchface.errors import ValueRangeError
from torchface.io.video import VideoFile, write_video
from torchface.landmarks.images.face_reading import FaceReading
from torchface.shape_names import ARKIT
from torchface.synthetic import performer
from torchface.workflows.browser_app.character import load_character
from torchface.workflows.live.live_frames import LiveFrame
from torchface.workflows.live.live_session import LiveSession, Notes
from torchface.workflows.live.live_view import LiveView
from torchface.workflows.live.recordings import Recordings
from torchface.workflows.live.weight_streams import WeightStreams

JAW = ARKIT.index("jawOpen")
SMILE = ARKIT.index("mouthSmileLeft")
FRONTAL = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


def film(path: Path, jaws: Sequence[float], fps: float = 25.0) -> Path:
    """A film of one shade a frame: the jaw's weight; black shows no face."""
    shades = (torch.tensor(jaws) * 200 + 40).round() * (torch.tensor(jaws) >= 0)
    write_video([shades.to(torch.uint8)[:, None, None, None].expand(-1, 3, 48, 64).contiguous()], path, fps)
    return path


class GrowingSmile:
    """Reads a smile that grows, of the embedded performer straight before the camera; no face at first."""

    beside = torch.zeros(2)

    def __init__(self) -> None:
        self.number = -1

    def step(self, image: torch.Tensor) -> FaceReading:
        self.number += 1
        if self.number == 0:
            return FaceReading.lost()
        rig, sure = performer(texture=False), torch.ones(68)
        weights = torch.zeros(1, len(rig.names))
        weights[0, rig.index(["mouthSmileLeft", "mouthSmileRight"])] = min(0.1 * self.number, 0.8)
        head = rig(weights)[0, rig.neutral.landmarks] * torch.tensor([1.0, -1, -1]) + torch.tensor([0.0, 0, 500])
        width, height = image.shape[2], image.shape[1]
        pixels = width * head[:, :2] / head[:, 2:] + 0.5 * (torch.tensor([width, height]) - 1)
        return FaceReading(pixels, 0.5 * sure, sure, sure[0])


class ShadeSolver:
    """Jaw by the picture's shade times the gain, smile by smoothing; keeps its controls."""

    names = ARKIT

    def __init__(self, *_: object) -> None:
        self.controls: list[WebcamControls] = []
        self.intervals: list[float | None] = []
        self.posed = self.resets = 0

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        if len(self.controls) < 330:
            self.controls.append(controls)
            self.intervals.append(interval)
        self.posed += controls.pose > 0
        self.resets += controls.reset
        shade = float(picture[24, 32].mean())
        height, width = picture.shape[:2]
        weights = torch.zeros(52)
        weights[JAW] = controls.gain * max(0.0, shade - 40) / 200
        weights[SMILE] = controls.smoothing
        t = torch.linspace(0, 6.28, 68)
        around = torch.stack([width / 2 + width / 5 * t.cos(), height / 2 + height / 4 * t.sin()], 1)
        seen = shade > 20
        learned = min(1.0, self.posed / 20)
        landmarks = around if seen else torch.full((68, 2), torch.nan)
        gaze = torch.tensor([[0.1, 0.2], [0.3, -0.2]])
        return LiveFrame(weights, FRONTAL, landmarks, around[[0, 34]], gaze, learned)


class Endless:
    """A source of as many frames as wanted, each at its time, without waiting."""

    def __init__(self, count: int, fps: float = 30.0, interrupt: bool = False) -> None:
        self.video = VideoFile(Path("planted"), fps, 64, 48, count)
        self.dropped, self.late, self.interrupt = 0, 0.0, interrupt

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        began = time.perf_counter()
        for number in range(self.video.count):
            yield began + number / self.video.fps, np.full((48, 64, 3), 40 + number % 200, np.uint8)
        if self.interrupt:
            raise KeyboardInterrupt

    def close(self) -> None:
        """Nothing to close."""


class Desk:
    """One moment again and again, and what was asked."""

    def __init__(self) -> None:
        self.messages: list[Mapping[str, Any]] = []
        self.kept: list[tuple[str, np.ndarray]] = []
        self.number, self.closed = 0, False

    def next_view(self, before: LiveView | None, seconds: float) -> LiveView | None:
        time.sleep(0.01)
        self.number += 1
        weights, marks = torch.arange(52) / 52, torch.full((68, 2), 7.0)
        gaze, beside = torch.tensor([[0.1, 0.2], [0.3, 0.4]]), torch.tensor([2.0, 0.0])
        solved = LiveFrame(weights, FRONTAL, marks, gaze=gaze, beside=beside, calibrated=0.5)
        picture = np.full((48, 64, 3), (200, 100, 50), np.uint8)
        return LiveView(self.number / 100, 0.01, 9.0, picture, solved)

    def state(self) -> dict[str, Any]:
        return {"words": "here"}

    def keep(self, name: str, rows: np.ndarray) -> None:
        self.kept.append((name, rows))

    def left(self) -> None:
        self.closed = True

    def asked(self, message: Mapping[str, Any]) -> None:
        self.messages.append(message)
        raise ValueRangeError("nobody may ask")


def a_session(source: Endless, folder: Path, dome: Path, told: list[str]) -> tuple[LiveSession, Recordings]:
    recordings = Recordings(folder, load_character(dome), "planted", source.video.fps)
    streams = WeightStreams((), ARKIT, source.video.fps, told.append)
    notes = Notes(told.append)
    return LiveSession(source, ShadeSolver(), streams, recordings, notes, told.append), recordings
