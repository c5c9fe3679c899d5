"""The figures of a live session, in memory that does not grow: counts and a histogram of latency."""

import math
from dataclasses import dataclass

import numpy as np

from torchface.io.tables.frame_rates import common_rate, typical_rate

_LEAST, _MOST, _STEP = 0.05, 60_000.0, 1.01  # milliseconds; what is reported is within 1 %
_RECENT = 2**12  # steps from frame to frame by which the rate is measured
_BINS = math.ceil(math.log(_MOST / _LEAST) / math.log(_STEP))


class LiveFigures:
    """Counts frames as they go."""

    def __init__(self) -> None:
        self.frames = self.found = 0
        self._histogram = np.zeros(_BINS + 1, np.int64)
        self._steps, self._fresh = np.zeros(_RECENT), 0
        self._first = self._last = self._came = 0.0

    def add(self, came: float, gone: float, seen: bool, fresh: bool = True) -> None:
        """Counts a frame that came and was sent on at these times, in seconds; ``fresh`` where somebody sent it."""
        self._first = self._first if self.frames else came
        self._last = gone
        if fresh:
            self._steps[(self._fresh - 1) % _RECENT] = came - self._came  # the first one's is replaced
            self._came = came
            self._fresh += 1
        self.frames += 1
        self.found += seen
        latency = 1000 * (gone - came)
        step = math.log(max(latency, _LEAST) / _LEAST) / math.log(_STEP)
        self._histogram[min(int(step), _BINS)] += 1

    def latency(self, quantile: float) -> float:
        """From a frame's arrival to its packets on the way, milliseconds; 0 before the first."""
        if self.frames == 0:
            return 0.0
        bin_number = int(np.searchsorted(self._histogram.cumsum(), max(1, math.ceil(quantile * self.frames))))
        return _LEAST * _STEP ** (bin_number + 0.5)

    @property
    def seconds(self) -> float:
        """From the first frame's arrival to the last one's leaving."""
        return self._last - self._first

    @property
    def fps(self) -> float:
        """Frames a second while they come, as a recording has them; 0 before the second."""
        steps = self._steps[: max(0, self._fresh - 1)]
        return common_rate(typical_rate(steps)) if steps.any() else 0.0


@dataclass(frozen=True)
class LiveReport:
    """What was sent."""

    figures: LiveFigures
    dropped: int  # frames that came while another was solved
    notes: tuple[str, ...] = ()  # what the user should know, such as receivers that were not there
    silence: str = ""  # that no face has come, where an address was listened at
    sent: bool = True  # whether weights were sent to an address
    reader: str = ""  # what has become of the graph that a first start makes

    def lines(self) -> list[str]:
        """For people to read."""
        figures = self.figures
        warnings = [f"warning: {note}" for note in self.notes]
        if self.silence:
            return [f"in {figures.seconds:.1f} s {self.silence}", *warnings]
        end = "packet" if self.sent else "weights"
        none = figures.frames > 0 and figures.found == 0
        return [
            f"{figures.frames} frames solved in {figures.seconds:.1f} s, a face in {figures.found}; they came at "
            f"{figures.fps:.1f} a second",
            f"{figures.latency(0.5):.1f} ms from frame to {end} (99th percentile {figures.latency(0.99):.1f} ms), "
            f"{self.dropped} frames were dropped, as they came while another was solved",
            *([self.reader] if self.reader else []),
            *(["warning: no face was found, so nothing has moved: weights and head stayed at rest"] if none else []),
            *warnings,
        ]
