"""Frame rates and frame numbers in files."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import torch

from torchface.errors import FileFormatError
from torchface.number_checks import MAX_FPS, MIN_FPS
from torchface.take import Take

COMMON_RATES = (
    *(24000 / 1001, 24.0, 25.0, 30000 / 1001, 30.0, 48.0, 50.0),
    *(60000 / 1001, 60.0, 72.0, 90.0, 100.0),
    *(120000 / 1001, 120.0),
)
"""Rates that cameras run at."""

DEFAULT_RATE = 60.0  # frames a second of a file of one frame at time 0, from which none follows

_MAX_FRAME_NUMBER = 2**32 - 1
_UNEVEN, _LIKE = 0.02, 0.2  # of a frame: so far from an even rate, and from the length of one
_FULL, _MILLISECOND = 1e-9, 1e-3
_NEAR = 0.002  # by which clocks and stated rates differ; 60 and 60000/1001 do by 0.001
_DIGITS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
_BROADCAST = tuple(1000 * whole / 1001 for whole in (24, 30, 48, 60, 120))
_SLOWEST = 3.0  # seconds from frame to frame: no film's, while milliseconds of 240 frames a second are beyond
_UNITS = ("milliseconds", "microseconds", "nanoseconds")
PAUSE = 8.0  # a step so many times the usual one is a pause
_CLOSE, _EVENLY = 0.25, 0.59  # so near is a step to the middle one, and so many are it, where frames come one by one
_ROUNDS = 3  # of averaging what is near the middle step; that one alone is rounded differently by each file
_GRID = 4.0  # times the typical rate; a grid of a higher one is not that of lost frames: some came at once
_TOGETHER = 8  # frames that a network may deliver at once
_EDGE = 64  # frames at either end of which the one counts that was delayed least
_AT_ONCE = 0.002  # seconds: frames that are so near came at once
_ALL, _SEEN = 0.9, 3  # share of steps that are of whole frames; frames beside a gap that show how many were lost


def simplest_rate(rate: float, agrees: Callable[[float], bool]) -> float:
    """A common rate, or else the fraction of the smallest denominator up to 1001, that equals ``rate`` as written.

    A file that holds 59.94006 in few digits meant 60000/1001. Where nothing ``agrees``, the rate stays.

    Example:
        >>> simplest_rate(59.94005966, lambda rate: abs(rate - 59.94005966) < 1e-6) == 60000 / 1001
        True
    """
    usual = sorted(COMMON_RATES, key=lambda other: abs(other - rate))[:2]
    fractions = [float(Fraction(rate).limit_denominator(largest)) for largest in (1, 10, 1001)]
    return next((candidate for candidate in (*usual, *fractions) if candidate > 0 and agrees(candidate)), rate)


def typical_rate(steps: np.ndarray) -> float:
    """Frames a second while they come, by steps (T,), seconds, not all 0.

    Pauses do not count. Lost frames do not where the others come one by one; where a network delays them, or
    delivers several at once, all that came count.

    Example:
        >>> round(typical_rate(np.array([1 / 60] * 300 + [5.0] + [1 / 60] * 300)), 6)
        60.0
        >>> round(typical_rate(np.array([0.001, 0.039] * 100)), 6)
        50.0
    """
    count, times = len(steps), np.concatenate([[0.0], np.cumsum(steps)])
    window = min(_TOGETHER, count // 4) if count >= _TOGETHER else min(2, max(1, count - 1))
    usual = _middle(times[window:] - times[:-window]) / window
    if usual == 0 or (usual < _AT_ONCE and window < _TOGETHER):  # too few to see how many a network delivers at once
        usual = float(steps.mean())
    middle = _middle(steps)
    for _ in range(_ROUNDS if middle > 0 else 0):
        near = _up_to(_CLOSE * middle, np.abs(steps - middle))
        middle = float((near @ steps) / near.sum())
    one_by_one = usual / 2 < middle < usual * (1 + _CLOSE)
    if one_by_one and near.mean() < _EVENLY:
        whole = np.maximum(np.rint(steps / middle), 1) * middle
        one_by_one = bool((np.abs(steps - whole) < _LIKE * middle).mean() > _ALL)
    period = middle if one_by_one else usual
    for _ in range(_ROUNDS):
        frames, lasting = _in_pieces(times, period, one_by_one)
        if not lasting / 2 < frames * period < 2 * lasting:
            break
        period = lasting / frames
    return 1 / period


def _in_pieces(times: np.ndarray, period: float, one_by_one: bool) -> tuple[float, float]:
    """How many frames there were between breaks, and for how many seconds, where they come about ``period`` apart.

    After a break all frames are later than those before it were; what a network held back is followed by frames that
    are not. Lost ones are counted where frames come ``one_by_one``.
    """
    steps, late = np.diff(times), times - period * np.arange(len(times))
    lost, starts, done, gone = np.zeros(len(times)), [0], 0, 0.0
    for row in np.flatnonzero(steps > 1.5 * period).tolist():
        late[done : row + 1] -= gone
        done = row + 1
        held = _TOGETHER + min(len(times), int(steps[row] / period))
        behind, ahead = late[max(starts[-1], done - _TOGETHER) : done], late[done : done + held] - gone
        missed = float(ahead.min() - behind.min()) / period
        if missed > (PAUSE - 1 if not one_by_one or min(len(ahead), len(behind)) >= _SEEN else 0.5):
            starts.append(done)
        elif one_by_one:
            lost[done], gone = round(missed), gone + round(missed) * period
    numbers = np.arange(len(times)) + np.cumsum(lost)
    late, frames, lasting = times - period * numbers, 0.0, 0.0
    for start, end in zip(starts, [*starts[1:], len(times)], strict=True):
        edge = max(1, min(_EDGE, (end - start) // 4))
        first = start + int(late[start : start + edge].argmin())
        last = end - edge + int(late[end - edge : end].argmin())
        frames, lasting = frames + float(numbers[last] - numbers[first]), lasting + float(times[last] - times[first])
    return frames, lasting


def _up_to(limit: float, values: np.ndarray) -> np.ndarray:
    """Weights (T,): 1 up to the limit, then less, and 0 from 1.2 of it on."""
    return np.clip(6 - 5 * values / limit, 0, 1)


def common_rate(rate: float) -> float:
    """The common rate within 0.2 %, which a clock may have meant; else the rate as it is."""
    common = min(COMMON_RATES, key=lambda other: abs(other - rate))
    return common if abs(rate / common - 1) <= _NEAR else rate


def _middle(values: np.ndarray) -> float:
    return float(np.quantile(values, 0.5, method="lower"))


@dataclass(frozen=True)
class FrameTimes:
    """When a file's frames are shown; ``Take.fps`` and ``Take.seconds`` of it."""

    fps: float
    seconds: torch.Tensor | None


@dataclass(frozen=True)
class TimeSource:
    """What is known of times before they are looked at."""

    error: Callable[[str, str], FileFormatError]  # makes an error of what was found and what was expected
    numbers: np.ndarray | None = None  # of the frames, (T,), rising, where the file has them
    rate: float | None = None  # frames a second that the file states
    resolution: float | None = None  # seconds by which times are rounded; seen in them if absent
    seconds: bool = False  # whether the format itself says that times are seconds


def file_error(where: object) -> Callable[[str, str], FileFormatError]:
    """Makes errors that begin with a file's name or a place in it."""
    return lambda found, expected: FileFormatError(f"{where}: found {found}, expected {expected}")


def frame_times(times: np.ndarray, source: TimeSource) -> FrameTimes:
    """The rate of frames (T,), seconds, and when each is shown where they do not come evenly, in every kind of file.

    Frames that lie on an even grid, dropped ones left out, get its times exactly; others keep the file's. Times in
    milliseconds or finer are repaired with a ``UserWarning``.
    """
    times = np.array(times, np.float64)  # of its own: a column holds its table in memory
    if not np.isfinite(times).all():
        row = int(np.flatnonzero(~np.isfinite(times))[0])
        raise source.error(f"no time in frame {row + 1}", "one in every row")
    if len(times) == 1:
        number = 0.0 if source.numbers is None else float(source.numbers[0])
        rate = source.rate or (
            number / times[0] if times[0] > 0 and number > 0 and not source.seconds else DEFAULT_RATE
        )
        return FrameTimes(_checked(rate, source), None)
    steps = np.diff(times)
    if (steps < 0).any():
        row = int(np.flatnonzero(steps < 0)[0])
        raise source.error(
            f"time {times[row + 1]:.10g} after {times[row]:.10g} in frame {row + 2}",
            "rising times: sort the rows by time, or cut the take there",
        )
    if not (steps > 0).any():
        raise source.error(f"one time, {times[0]:.10g}, in all of {len(times)} frames", "rising times")
    times = times if source.seconds else _in_seconds(times, source)
    resolution = _resolution(times) if source.resolution is None else source.resolution
    repeated = not (np.diff(times) > 0).all()
    for numbers in (source.numbers, _counted(times), np.arange(len(times)) if repeated else None):
        if numbers is None or not (np.diff(numbers) > 0).all():
            continue
        count, duration = float(numbers[-1] - numbers[0]), float(times[-1] - times[0])
        place = (numbers - numbers[0]) / count
        if np.abs(times - times[0] - place * duration).max() <= _UNEVEN * duration / count + resolution:
            rate = _rate(count, duration, resolution, source.rate)
            if rate < MIN_FPS:
                return FrameTimes(MIN_FPS, torch.from_numpy(times))
            rate, even = _checked(rate, source), count == len(times) - 1
            return FrameTimes(rate, None if even else torch.from_numpy(times[0] + (numbers - numbers[0]) / rate))
    if repeated:  # more than by rounding
        row = int(np.flatnonzero(np.diff(times) == 0)[0])
        raise source.error(
            f"time {times[row + 1]:.10g} after {times[row]:.10g} in frame {row + 2}",
            "rising times: keep one row of each time",
        )
    steps = np.diff(times)
    if source.rate is not None and np.abs(steps * source.rate - 1).min() <= _LIKE:
        return FrameTimes(source.rate, torch.from_numpy(times))
    rate = max(MIN_FPS, common_rate(typical_rate(steps)))
    return FrameTimes(_checked(rate, source), torch.from_numpy(times))


def key_times(times: np.ndarray, error: Callable[[str, str], FileFormatError], rate: float | None = None) -> FrameTimes:
    """When the keys of an animation at ``times`` (T,), seconds in single precision, are shown, from 0; ``rate`` is the
    stated one."""
    times = times.astype(np.float64) - float(times[0])
    resolution = 2 * float(np.spacing(np.float32(times[-1])))
    return frame_times(times, TimeSource(error, rate=rate, resolution=resolution, seconds=True))


def _checked(rate: float, source: TimeSource) -> float:
    if not MIN_FPS <= rate <= MAX_FPS:
        raise source.error(f"{rate:.6g} frames a second", f"{MIN_FPS} to {MAX_FPS:.0f}")
    return rate


def _rate(count: float, duration: float, resolution: float, stated: float | None) -> float:
    """The rate that is stated, where it is near; else the simplest one at which so many frames take so long, as far as
    times are known."""
    if stated is not None and abs(count / stated - duration) <= max(resolution, _NEAR * duration):
        return stated
    rate = count / duration
    written = float(Fraction(rate).limit_denominator(10))
    if abs(rate - written) <= _FULL * rate:
        return written
    rounding = resolution if resolution <= max(_MILLISECOND, _NEAR * duration) else _FULL
    usual = next((one for one in _BROADCAST if abs(count / one - duration) <= rounding), None)
    if usual is not None:  # a fraction that meets a rounded duration by chance is no nearer the truth
        return usual
    for digits in (_FULL, rounding):
        simple = simplest_rate(rate, lambda other, d=digits: abs(count / other - duration) <= d)  # type: ignore[misc]
        if simple != rate:
            return simple
    return rate


def _in_seconds(times: np.ndarray, source: TimeSource) -> np.ndarray:
    """Times in seconds, where their steps say that they are in thousandths, or thousandths of these."""
    steps = np.diff(times)
    usual, unit = float(np.quantile(steps[steps > 0], 0.25, method="lower")), 0  # whatever gaps there are
    while usual >= _SLOWEST and unit < len(_UNITS):
        usual, unit = usual / 1000, unit + 1
    if unit == 0:
        return times
    what = f"frames {float(np.median(steps[steps > 0])):.6g} apart"
    warnings.warn(str(source.error(what, "seconds")) + f"; they are taken for {_UNITS[unit - 1]}", stacklevel=4)
    return times / 1000.0**unit


def _resolution(times: np.ndarray) -> float:
    """The coarsest power of ten, up to a hundredth, of which all times are multiples."""
    for digits in _DIGITS:
        if np.abs(np.rint(times / digits) * digits - times).max() <= _FULL * max(1.0, float(np.abs(times).max())):
            return digits
    return 0.0


def _counted(times: np.ndarray) -> np.ndarray:
    """Frame numbers (T,) that steps of the usual length give; they do not rise where times are no frames'."""
    steps = np.diff(times)
    usual = _middle(steps[steps > 0])
    unit = float(steps[np.abs(steps - usual) < usual / 2].mean())
    if 1 / unit > _GRID * typical_rate(steps):
        return np.zeros(len(times))
    return np.concatenate([[0.0], np.cumsum(np.rint(steps / unit))])


def numbering_extras(numbers: np.ndarray, first: int, where: str) -> dict[str, Any]:
    """What ``Take.extras`` keeps of a file's frame numbers (T,), which count from ``first`` or 0: nothing where they
    simply count up from there."""
    if not np.all((numbers >= 0) & (numbers <= _MAX_FRAME_NUMBER) & (numbers == np.floor(numbers))):
        raise FileFormatError(
            f"{where}: found frame numbers that are negative or no whole numbers, expected 0, 1, 2, ..."
        )
    steps = np.diff(numbers)
    if np.any(steps <= 0):
        row = int(np.flatnonzero(steps <= 0)[0])
        raise FileFormatError(
            f"{where}: found frame {numbers[row + 1]:.0f} after frame {numbers[row]:.0f}, expected rising numbers"
        )
    first = min(first, int(numbers[0])) if len(numbers) else first
    if len(numbers) == 0 or (numbers[0] == first and np.all(steps == 1)):
        return {}
    return {"frame_numbers": torch.from_numpy(numbers.astype(np.int64) - first)}


def frame_numbers(take: Take, first: int) -> Sequence[int]:
    """The numbers to write in a format that counts from ``first``."""
    return (take.numbers + first).tolist()
