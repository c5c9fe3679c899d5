"""Ten seconds in which a person holds five faces, so that the solver learns theirs."""

from __future__ import annotations

from dataclasses import dataclass, replace

_STEP, _READY = 2.0, 0.7  # seconds a face, and those in which the person gets into it

STEPS = (
    "Look into the camera, face at rest",
    "Open your mouth wide",
    "Smile as widely as you can",
    "Raise your brows",
    "Shut your eyes for two seconds",
)
"""What is asked for, in words; poses 1 to 5 of the solver."""


@dataclass(frozen=True)
class GuidedCalibration:
    """How far it is; the clock stands while no face is seen.

    Args:
        elapsed: seconds, 0 to 10.
    """

    elapsed: float = 0.0

    def after(self, seconds: float, seen: bool) -> GuidedCalibration | None:
        """The state after a frame; None when it is over."""
        moved = replace(self, elapsed=self.elapsed + seconds if seen else self.elapsed)
        return moved if moved.elapsed < _STEP * len(STEPS) else None

    @property
    def step(self) -> int:
        """Which face is asked for, from 0."""
        return min(int(self.elapsed / _STEP), len(STEPS) - 1)

    @property
    def pose(self) -> int:
        """The pose that the solver may learn from now; 0 while the person gets into it."""
        return self.step + 1 if self.elapsed - _STEP * self.step >= _READY else 0

    @property
    def left(self) -> float:
        """Seconds until the next face."""
        return _STEP * (self.step + 1) - self.elapsed

    @property
    def words(self) -> str:
        """What to do now.

        Example:
            >>> GuidedCalibration(2.5).words
            '2 of 5: Open your mouth wide'
        """
        return f"{self.step + 1} of {len(STEPS)}: {STEPS[self.step]}"
