"""Timecodes ``HH:MM:SS:FF.sss`` as Live Link Face writes them: the rate they run at, and the frames they skip."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.io.tables.csv_table import quoted
from torchface.io.tables.frame_rates import TimeSource, common_rate, file_error, frame_times, typical_rate
from torchface.number_checks import MIN_FPS, check_rate

_PATTERN = re.compile(r"([0-9]{1,2}):([0-9]{1,2}):([0-9]{1,2})([:;])([0-9]{1,3}(?:\.[0-9]{1,9})?)")
_DAY = 24 * 3600
_USUAL = 60
_BASES = (24, 25, 30, 48, 50, 60, 72, 90, 96, 100, 120, 240)


@dataclass(frozen=True)
class Timing:
    """What the timecodes of a take say."""

    fps: float  # frames a second, a usual rate where the clock runs within 0.2 % of one
    measured: float
    seconds: Tensor | None  # when each frame is shown, (T,) from 0, where they come unevenly


def read_timecodes(texts: Sequence[str], path: Path) -> Timing:
    """The timing of a take from its timecodes.

    ``FF`` counts frames of the timecode's base (60 for a 59.94 fps take), which is where it falls back to 0 as the
    seconds rise; a take without such a place has base 60 if it fits. ``;`` before ``FF`` marks drop-frame timecode.
    The rate is the usual one of their steps (:func:`typical_rate`), gaps left out. Midnight is crossed.
    """
    seconds = np.empty(len(texts), np.int64)
    frames = np.empty(len(texts))
    drop = False
    for row, text in enumerate(texts):
        match = _PATTERN.fullmatch(text)
        if match is None or int(match[1]) > 23 or int(match[2]) > 59 or int(match[3]) > 59:
            raise FileFormatError(
                f"{path}: frame {row + 1}: found the timecode {quoted([text])}, expected HH:MM:SS:FF.sss"
            )
        seconds[row] = 3600 * int(match[1]) + 60 * int(match[2]) + int(match[3])
        frames[row] = float(match[5])
        drop |= match[4] == ";"
    base = _base(seconds, frames, drop)
    clock = seconds * base + frames
    rate_of_base, day = float(base), _DAY * base
    if drop and base % 30 == 0:  # every minute but each tenth lacks its first numbers, and 1000/1001 makes up for it
        minutes = seconds // 60
        clock -= base // 15 * (minutes - minutes // 10)
        rate_of_base, day = base * 1000 / 1001, day - base // 15 * 1296
    if len(texts) == 1:
        fps = check_rate(rate_of_base, str(path))
        return Timing(fps, fps, None)
    steps = np.diff(clock)
    steps = np.where(steps < -day / 2, steps + day, steps)
    if not np.any(steps > 0):
        raise FileFormatError(
            f"{path}: found {len(texts)} timecodes from {texts[0]} on that never rise, expected a clock"
        )
    if np.any(steps < 0):
        row = int(np.flatnonzero(steps < 0)[0])
        raise FileFormatError(
            f"{path}: found the timecode {texts[row + 1]} in frame {row + 2} after {texts[row]}, expected a clock that "
            "goes on: sort the rows by time, or cut the take there"
        )
    measured = typical_rate(steps[steps > 0] / rate_of_base)  # frames of one timecode came between two of its clock
    fps = check_rate(max(MIN_FPS, common_rate(measured)), f"{path}: timecodes")
    since = np.concatenate([[0.0], np.cumsum(steps)]) / rate_of_base
    source = TimeSource(file_error(path), rate=fps, resolution=_digits(texts) / rate_of_base, seconds=True)
    found = frame_times(since, source)
    return Timing(found.fps, measured, found.seconds)


def _digits(texts: Sequence[str]) -> float:
    """The part of a frame that timecodes are rounded to."""
    return 10.0 ** -max(len(text.partition(".")[2]) for text in texts)


def _base(seconds: np.ndarray, frames: np.ndarray, drop: bool) -> int:
    rise, within = np.diff(seconds) % _DAY, np.diff(frames)
    steps = within[(rise == 0) & (within > 0)]
    falls = (rise == 1) & (within < 0) & ~(drop & (seconds[1:] % 60 == 0))  # where numbers are dropped FF falls less
    wraps = (frames[:-1] - frames[1:])[falls]
    bases = [base for base in ((30, _USUAL) if drop else (_USUAL, *_BASES)) if base > frames.max()]
    if not len(steps) or not len(wraps):
        return next(iter(bases), 1000)
    # Where frames were dropped FF falls by less: only the largest falls are the base less a usual step.
    typical = float(np.median(steps))
    fall = round(float(np.median(wraps[wraps > wraps.max() - typical])) + typical)
    bases += [fall] if fall > frames.max() else []

    def fault(base: int) -> float:
        """How far the steps over a second's end are from those within one."""
        over = base - wraps
        return math.inf if over.min() <= 0 else float(np.abs(np.clip(over, steps.min(), steps.max()) - over).mean())

    least = min(map(fault, bases), default=math.inf)
    return next((base for base in bases if fault(base) <= least + typical / 2), 1000)


def write_timecodes(count: int, fps: float, first: int = 0) -> tuple[str, ...]:
    """Timecodes of ``count`` frames from number ``first`` on, 0 at midnight, in thousandths of the base's frames.

    The base is the rate, and 60 where too few frames come for a second's end to show it.
    """
    base = max(1, round(fps)) if count > fps else _USUAL
    return _texts(np.rint(np.arange(first, first + count) * (1000 * base / fps)), base)


def timecodes_at(seconds: np.ndarray) -> tuple[str, ...]:
    """Timecodes of times (T,), 0 at midnight, in thousandths of sixtieths: what a reader takes, whatever the steps."""
    return _texts(np.rint(seconds * (1000 * _USUAL)), _USUAL)


def _texts(ticks: np.ndarray, base: int) -> tuple[str, ...]:
    ticks = ticks.astype(np.int64)
    seconds, parts = ticks // (1000 * base) % _DAY, ticks % (1000 * base)
    return tuple(
        f"{second // 3600:02d}:{second // 60 % 60:02d}:{second % 60:02d}:{part // 1000:02d}.{part % 1000:03d}"
        for second, part in zip(seconds.tolist(), parts.tolist(), strict=True)
    )
