"""Frames in real time, from a camera or a video played at its own rate, and what is solved of each."""

import math
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.capture.anybody import WebcamControls
from torchface.io.video import VideoFile, open_video
from torchface.workflows.head_rotations import eye_angles, head_angles
from torchface.workflows.live.camera import DEFAULT_SIZE, Camera

Say = Callable[[str], None]
"""Takes a sentence for the user."""


class FrameSource(Protocol):
    """Where frames come from.

    ``video`` holds rate and size, ``dropped`` how many frames came while another was worked on, ``late`` by how many
    seconds a film that loses no frame has fallen behind its own time.
    """

    @property
    def video(self) -> VideoFile: ...

    @property
    def dropped(self) -> int: ...

    @property
    def late(self) -> float: ...

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        """When each frame came, seconds, and the frame, uint8 (H,W,3), red first."""

    def close(self) -> None:
        """Gives the camera back."""


@dataclass(frozen=True)
class SourceSettings:
    """How frames are given."""

    size: tuple[int, int] = DEFAULT_SIZE  # width and height to ask a camera for
    # give every frame of a video, however late, as for a recording; else those that come too late are dropped
    every: bool = False
    loop: bool = False  # play a video again and again


_DEFAULT = SourceSettings()
_LONGEST_GAP = 0.5  # seconds of a film that are left out at once
_WORTH = 0.25  # frames that leaving one out has to gain


class PlayedVideo:
    """A video file whose frames, at any times, come at its own rate, as a camera's would."""

    def __init__(self, path: Path, settings: SourceSettings = _DEFAULT) -> None:
        self.video = replace(open_video(path), even=False)
        self.dropped, self.late = 0, 0.0
        self._settings = settings
        self._times, _ = self.video.uneven_seconds()

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        """When each frame was due in the film's own time, and the frame, uint8 (H,W,3), red first."""
        again = True
        while again:
            again = False
            for frame in self._once():
                again = self._settings.loop
                yield frame

    def _once(self) -> Iterator[tuple[float, np.ndarray]]:
        started: float | None = None
        skipped, before = 0, 0.0
        for number, frame in enumerate(self.video.color_frames()):
            if started is None:
                started = time.perf_counter() - self.late  # with the first frame: opening takes a while
            due = started + self._time(number)
            early = due + self.late - time.perf_counter()
            if early > 0:
                time.sleep(early)
            elif (over := -early > 1 / self.video.fps) and self._settings.every:
                self.late -= early
            elif over:  # a camera would have shown the next one by now
                gained = (before + early) * self.video.fps if skipped else 1.0  # frames, by the one before
                if skipped < _LONGEST_GAP * self.video.fps and gained > _WORTH:
                    self.dropped, skipped, before = self.dropped + 1, skipped + 1, -early
                    continue
                # It cannot be decoded in its own time, and then it is played in a longer one.
                started, due = started - early, due - early
            skipped = 0
            yield due, frame.permute(1, 2, 0).contiguous().numpy()

    def _time(self, number: int) -> float:
        if self._times is None or number >= len(self._times):
            return number / self.video.fps
        return float(self._times[number])

    def close(self) -> None:
        """A file needs no closing."""


def open_source(camera: str, say: Say, settings: SourceSettings = _DEFAULT) -> FrameSource:
    """A camera by its number, or a video file by its path; ``say`` is called with what happens to the camera on the
    way."""
    if re.fullmatch("[0-9]{1,3}", camera):
        return Camera(int(camera), say, settings.size)
    return PlayedVideo(Path(camera), settings)


def planes(picture: np.ndarray) -> torch.Tensor:
    """A picture (H,W,3) as a tensor (3,H,W)."""
    height, width = picture.shape[:2]
    split = np.empty((3, height, width), np.uint8)
    cv2.split(picture, list(split))
    return torch.from_numpy(split)


_SHORTEST = 1e-3  # seconds between frames


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """One frame as it was solved."""

    weights: Tensor  # (N,)
    rotation: Tensor  # of the head, rig to camera, (3,3); NaN before the first face
    landmarks: Tensor  # (68,2), pixels; NaN where the face is lost
    # centres of the irises, right eye first, (2,2) pixels; NaN where nothing finds them
    iris: Tensor = field(default_factory=lambda: torch.full((2, 2), torch.nan))
    # right eye first, to the person's left and up, (2,2) radians
    gaze: Tensor = field(default_factory=lambda: torch.zeros(2, 2))
    calibrated: float = 1.0  # how far the person is learned, in [0,1]
    found: bool = False  # whether a face is there, where no landmarks say so
    fresh: bool = True  # whether somebody sent it; else it is what is shown while nobody does
    sent: float = math.nan  # when, by the sender's clock in seconds, where it has one
    # the picture with what was solved drawn over it, uint8 (H,W,3); the page shows it in the picture's place
    drawn: np.ndarray | None = None
    # how many other people stand to the left of the face in the picture, and to the right, smoothed, (2,)
    beside: Tensor = field(default_factory=lambda: torch.zeros(2))

    @cached_property
    def seen(self) -> bool:
        """Whether a face is there."""
        return self.found or bool(torch.isfinite(self.landmarks).all(1).any())

    @cached_property
    def rotations(self) -> Tensor:
        """Live Link Face's nine of head and eyes, radians, (9,) float64; 0 before the first face."""
        head = head_angles(self.rotation.detach().cpu().double()).nan_to_num(0.0)
        return torch.cat([head, eye_angles(self.gaze.detach().cpu().double()).nan_to_num(0.0)])


class FaceSolver(Protocol):
    """Solves one frame after another; ``names`` are its weights'."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        """Solves the next frame, uint8 (H,W,3), red first, ``interval`` seconds after the last; absent for the
        first."""


def solved_frames(
    source: FrameSource, solver: FaceSolver, controls: Callable[[], WebcamControls] = WebcamControls
) -> Iterator[tuple[float, np.ndarray, LiveFrame]]:
    """When each frame came, the frame, and what was solved of it."""
    before: float | None = None
    for came, picture in source.frames():
        interval = None if before is None else max(came - before, _SHORTEST)
        before = came
        yield came, picture, solver.step(picture, interval, controls())
