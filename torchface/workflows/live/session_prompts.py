"""Prompts of a live session: the guided calibration, and what is wrong with a picture."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from torchface.shape_names import ARKIT
from torchface.workflows.live.live_frames import LiveFrame, planes

_STEP, _READY = 2.0, 0.7  # seconds a face, and those in which the person gets into it

STEPS = (
    "Look into the camera, face at rest",
    "Open your mouth wide",
    "Smile as widely as you can",
    "Raise your brows",
    "Shut your eyes for two seconds",
)
"""What is asked for, in words; poses 1 to 5 of the solver."""


_SHAPES = ((), ("jawOpen",), ("mouthSmileLeft", "mouthSmileRight"), ("browInnerUp",), ("eyeBlinkLeft", "eyeBlinkRight"))
_SEEN_IN = tuple(tuple(ARKIT.index(name) for name in names) for names in _SHAPES)
_LEAST = 0.2  # of a weight over rest: a pose that is shown


@dataclass(frozen=True)
class GuidedCalibration:
    """How far it is, where no page guides; the clock stands while no face is seen."""

    elapsed: float = 0.0  # seconds, 0 to 10
    rest: tuple[float, ...] = (0.0,) * len(STEPS)  # weights of each pose's shapes at rest, (5,)
    most: tuple[float, ...] = (0.0,) * len(STEPS)  # and the largest while it was asked for, (5,)

    def after(self, seconds: float, solved: LiveFrame) -> "GuidedCalibration | None":
        """The state after a frame; None when it is over."""
        if not solved.seen:
            return self
        shown = [float(solved.weights[list(rows)].mean()) if rows else 0.0 for rows in _SEEN_IN]
        rest = tuple(shown) if self.step == 0 else self.rest
        most = tuple(
            max(was, now) if i == self.step else was for i, (was, now) in enumerate(zip(self.most, shown, strict=True))
        )
        moved = GuidedCalibration(self.elapsed + seconds, rest, most)
        return moved if moved.elapsed < _STEP * len(STEPS) else None

    @property
    def result(self) -> str:
        """What came of the poses that were asked for so far."""
        asked = range(1, self.step + 1)
        missed = [STEPS[i] for i in asked if self.most[i] - self.rest[i] < _LEAST]
        if missed and len(missed) == len(asked):
            return f"Not calibrated: no pose was seen ({'; '.join(missed)})"
        return f"Calibrated in part; not seen: {'; '.join(missed)}" if missed else "Calibrated"

    @property
    def step(self) -> int:
        """Which face is asked for, from 0."""
        return min(int(self.elapsed / _STEP), len(STEPS) - 1)

    @property
    def pose(self) -> int:
        """The pose that the solver may learn from now; 0 while the person gets into it."""
        return self.step + 1 if self.elapsed - _STEP * self.step >= _READY else 0

    @property
    def words(self) -> str:
        """What to do now.

        Example:
            >>> GuidedCalibration(2.5).words
            '2 of 5: Open your mouth wide'
        """
        return f"{self.step + 1} of {len(STEPS)}: {STEPS[self.step]}"


_INTERVAL, _SOON = 3.0, 0.3  # seconds between two counts of faces; where the last two differ, or the face was lost
_DARK = 35.0  # mean of the brightest of the colours, of 255
_SPARSE = 8  # pixels
_NUMBERS = ("No", "One", "Two", "Three", "Four")

FOLLOWED = "Your face is followed"
"""What is said of a face that is seen, and of no other."""


class Watch(Protocol):
    """Looks at frames as they pass.

    ``words`` are what the user should know, ``mirrored`` whether the user sees the picture as in a mirror.
    """

    words: str
    mirrored: bool

    def look(self, picture: np.ndarray, solved: LiveFrame, now: float) -> None:
        """Updates ``words`` by a frame, uint8 (H,W,3), and what was solved of it."""


class FaceWatch:
    """Looks at frames as they pass; faces are looked for now and then beside them, in a thread.

    Args:
        find: the boxes of faces in a picture (3,H,W): rows of x, y, width and height, pixels.
    """

    def __init__(self, find: Callable[..., Sequence[Sequence[float]]]) -> None:
        self._find = find
        self._middles: list[float] = []
        self._counted, self._last = 0, float("-inf")
        self._settled = self._ever = False
        self._looking: threading.Thread | None = None
        self.words, self.mirrored = "", True

    def look(self, picture: np.ndarray, solved: LiveFrame, now: float) -> None:
        """Updates ``words`` by a frame, uint8 (H,W,3), and what was solved of it."""
        seen = solved.seen
        self._ever |= seen
        self._settled &= seen
        due = now >= self._last + (_INTERVAL if self._settled else _SOON)
        if seen and due and (self._looking is None or not self._looking.is_alive()):
            self._last = now
            # No daemon: the program's end inside the network would end in an abort.
            self._looking = threading.Thread(target=self._look_for_others, args=(picture,))
            self._looking.start()
        if seen and len(self._middles) > 1:
            self.words = self._which(float(solved.landmarks[:, 0].nanmean()))
        elif seen:
            self.words = FOLLOWED
        elif picture[::_SPARSE, ::_SPARSE].max(2).mean() < _DARK:
            self.words = "Too dark to see a face: put a light before you"
        elif self._ever:
            self.words = "Your face is hidden: the last expression is held, then relaxes"
        else:
            self.words = "No face yet: sit before the camera and look into it"

    def _which(self, at: float) -> str:
        middles = sorted(self._middles, reverse=self.mirrored)
        place = min(range(len(middles)), key=lambda i: abs(middles[i] - at))
        name = "left" if place == 0 else "right" if place == len(middles) - 1 else "middle"
        count = _NUMBERS[len(middles)] if len(middles) < len(_NUMBERS) else str(len(middles))
        return f"{count} people: following the {name} one"

    def _look_for_others(self, picture: np.ndarray) -> None:
        middles = [float(box[0]) + float(box[2]) / 2 for box in self._find(planes(picture))]
        self._settled = len(middles) == self._counted  # now and then something else looks like a face for a moment
        self._counted = len(middles)
        if self._settled:
            self._middles = middles
