"""Prompts of a live session: the guided calibration, and what is wrong with a picture."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from torchface.shape_names import ARKIT
from torchface.workflows.live.live_frames import LiveFrame

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
        return f"Calibrated, but these poses were not seen: {'; '.join(missed)}" if missed else "Calibrated"

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


_DARK = 35.0  # mean of the brightest of the colours, of 255
_SPARSE = 8  # pixels


class Watch(Protocol):
    """Looks at frames as they pass; ``words`` are what the user should know."""

    words: str

    def look(self, picture: np.ndarray, solved: LiveFrame, now: float) -> None:
        """Updates ``words`` by a frame, uint8 (H,W,3), and what was solved of it."""


class LightWatch:
    """Looks at frames as they pass; what a face says for itself, the page puts into words."""

    words = ""

    def look(self, picture: np.ndarray, solved: LiveFrame, now: float) -> None:
        """Updates ``words`` by a frame, uint8 (H,W,3), and what was solved of it."""
        dark = not solved.seen and picture[::_SPARSE, ::_SPARSE].max(2).mean() < _DARK
        self.words = "Too dark to see a face: put a light before you." if dark else ""
