"""Frames solved one after another as they come, by whatever solves faces."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from torchface.capture.anybody import WebcamControls
from torchface.workflows.live.live_frames import FrameSource
from torchface.workflows.track.head_rotations import eye_angles, head_angles

_SHORTEST = 1e-3  # seconds between frames


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """One frame as it was solved.

    Args:
        weights: (N,).
        rotation: of the head, rig to camera, (3,3); NaN before the first face.
        landmarks: (68,2), pixels; NaN where the face is lost.
        iris: centres of the irises, right eye first, (2,2) pixels; NaN where nothing finds them.
        gaze: right eye first, to the person's left and up, (2,2) radians.
        calibrated: how far the person is learned, in [0,1].
    """

    weights: Tensor
    rotation: Tensor
    landmarks: Tensor
    iris: Tensor = field(default_factory=lambda: torch.full((2, 2), torch.nan))
    gaze: Tensor = field(default_factory=lambda: torch.zeros(2, 2))
    calibrated: float = 1.0

    @cached_property
    def seen(self) -> bool:
        """Whether a face is there."""
        return bool(torch.isfinite(self.landmarks).all(1).any())

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
        """Solves the next frame.

        Args:
            picture: uint8 (H,W,3), red first.
            interval: seconds since the frame before; absent for the first.
            controls: what the user set.
        """


def solved_frames(
    source: FrameSource, solver: FaceSolver, controls: Callable[[], WebcamControls] = WebcamControls
) -> Iterator[tuple[float, np.ndarray, LiveFrame]]:
    """When each frame came, the frame, and what was solved of it."""
    before: float | None = None
    for came, picture in source.frames():
        interval = None if before is None else max(came - before, _SHORTEST)
        before = came
        yield came, picture, solver.step(picture, interval, controls())
