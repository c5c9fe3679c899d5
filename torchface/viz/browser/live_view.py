"""View of a live page: what it shows, and what it may ask for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from torch import Tensor


@dataclass(frozen=True, eq=False)
class LiveView:
    """One moment of a live session.

    Args:
        picture: of the camera, uint8 (H,W,3), red first.
        landmarks: (68,2), pixels; NaN without a face.
        iris: centres of the irises, (2,2), pixels; NaN where nothing finds them.
        weights: by ARKit's names, (52,).
        rotation: of the head, rig to camera, (3,3); NaN before the first face.
        seen: whether a face is there.
        words: what the user should know of the picture.
        fps: frames a second.
        latency: from a frame's arrival to its packets on the way, milliseconds.
        calibrated: how far the person is learned, in [0,1].
        prompt: what a guided calibration asks for; empty without one.
        left: seconds until it asks for the next.
        recording: seconds that are recorded; None without a recording.
        notes: sentences shown to the user, newest last.
    """

    picture: np.ndarray
    landmarks: Tensor
    iris: Tensor
    weights: Tensor
    rotation: Tensor
    seen: bool
    words: str
    fps: float
    latency: float
    calibrated: float
    prompt: str = ""
    left: float = 0.0
    recording: float | None = None
    notes: tuple[str, ...] = ()


class LiveDesk(Protocol):
    """What a page may ask of a live session; called from other threads than the session's.

    ``gain`` and ``smoothing`` are the solver's: 1 and 0.5 are usual.
    """

    gain: float
    smoothing: float

    def view(self) -> LiveView | None:
        """The newest moment; None before the first frame."""

    def calibrate(self) -> None:
        """Begins a guided calibration."""

    def reset(self) -> None:
        """Has the solver forget the person."""

    def record(self, on: bool) -> str:
        """Begins or ends a recording; says in words what happened."""
