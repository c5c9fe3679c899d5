"""Playback of a take: the frame that is due at a moment."""

from bisect import bisect_right
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Playback:
    """The state of a timeline; moments are seconds of one clock, such as ``time.monotonic()``."""

    frames: int
    fps: float  # frames a second at speed 1
    speed: float = 1.0  # 1 is the take's own
    loop: bool = True  # begin again at the end
    started: float | None = None  # when it was set playing; stopped if absent
    origin: int = 0  # the frame at that moment, or the frame it stands at
    # when each frame is shown, seconds after the first, where they come unevenly
    times: tuple[float, ...] | None = None

    @property
    def playing(self) -> bool:
        """Whether time moves it."""
        return self.started is not None

    def frame(self, now: float) -> int:
        """The frame due at ``now``.

        Example:
            >>> Playback(frames=100, fps=30, speed=0.5).play(now=10.0).frame(now=12.0)
            30
        """
        if self.started is None:
            return self.origin
        if self.times is not None:
            at = self.times[self.origin] + (now - self.started) * self.speed + 1e-6
            return bisect_right(self.times, at % (self.times[-1] + 1 / self.fps) if self.loop else at) - 1
        # A small tolerance: (now - started) * fps of a whole frame may come out a rounding below it.
        elapsed = self.origin + int((now - self.started) * self.fps * self.speed + 1e-6)
        return elapsed % self.frames if self.loop else min(elapsed, self.frames - 1)

    def ended(self, now: float) -> bool:
        """Whether it plays without a loop and has reached the last frame."""
        return self.playing and not self.loop and self.frame(now) == self.frames - 1

    def play(self, now: float) -> "Playback":
        """Playing from where it stands; from the beginning where it stands at the end."""
        frame = self.frame(now)
        return replace(self, started=now, origin=0 if frame == self.frames - 1 else frame)

    def pause(self, now: float) -> "Playback":
        """Stopped at the frame due."""
        return replace(self, started=None, origin=self.frame(now))

    def seek(self, frame: int, now: float) -> "Playback":
        """At another frame, playing on if it played."""
        clamped = min(max(frame, 0), self.frames - 1)
        return replace(self, started=now if self.playing else None, origin=clamped)

    def paced(self, now: float, speed: float | None = None, loop: bool | None = None) -> "Playback":
        """With another speed or loop, from the frame due on."""
        here = self.seek(self.frame(now), now)
        return replace(here, speed=self.speed if speed is None else speed, loop=self.loop if loop is None else loop)
