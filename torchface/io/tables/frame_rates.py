"""Frame rates and frame numbers in files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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

DEFAULT_RATE = 60.0
"""Frames a second of a file of one frame at time 0, from which none follows."""

_MAX_FRAME_NUMBER = 2**32 - 1
_UNEVEN = 0.01
# Cameras drop a few frames in a row. Keys further apart are poses that a program blends: baked, they are frames.
_LONGEST_GAP = 10.0


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


def rate_of_keys(times: np.ndarray, error: Callable[[str, str], FileFormatError]) -> tuple[float, torch.Tensor | None]:
    """Frames a second of an animation's keys at ``times`` (T,), seconds in single precision; and when each is shown,
    (T,) from 0, where they come unevenly.

    Args:
        times: of the keys.
        error: makes an error of what was found and what was expected.
    """
    if len(times) == 1:
        return DEFAULT_RATE, None
    steps = np.diff(times.astype(np.float64))
    usual = float(np.median(steps))
    if not (steps.min() > 0 and steps.max() <= _LONGEST_GAP * usual):
        worst = float(steps.min() if not steps.min() > 0 else steps.max())
        raise error(
            f"keys {worst} s apart, the median being {usual:.6f}",
            f"frames, rising and at most {_LONGEST_GAP:.0f} steps apart: bake the animation",
        )
    step = (float(times[-1]) - float(times[0])) / (len(times) - 1)
    even = bool(np.abs(steps - step).max() <= _UNEVEN * step)
    slack = 2 * float(np.spacing(np.float32(times[-1])))
    step = step if even else usual
    rate = simplest_rate(1 / step, lambda other: abs((len(times) - 1) * (1 / other - step)) <= slack)
    if not MIN_FPS <= rate <= MAX_FPS:
        raise error(f"{rate:.4g} frames a second", f"{MIN_FPS} to {MAX_FPS:.0f}")
    return rate, None if even else torch.from_numpy(times.astype(np.float64) - float(times[0]))


def frame_gaps(steps: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Where frames were dropped, as (row, how many are missing before it); ``steps`` (T-1,) are frames from row to row.

    A negative count says that the numbering, or the clock, falls back there.
    """
    missing = np.rint(steps).astype(np.int64) - 1
    return tuple((int(row) + 1, int(missing[row])) for row in np.flatnonzero(missing))


def numbering_extras(numbers: np.ndarray, first: int, where: str) -> dict[str, Any]:
    """What ``Take.extras`` keeps of a file's frame numbers (T,): nothing where they simply count up from ``first``.

    Raises:
        FileFormatError: a number is no whole one, is negative, or does not rise.
    """
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
    if len(numbers) == 0 or (numbers[0] == first and np.all(steps == 1)):
        return {}
    extras: dict[str, Any] = {"frame_numbers": torch.from_numpy(numbers.astype(np.int64))}
    gaps = frame_gaps(steps)
    if gaps:
        extras["gaps"] = gaps
    return extras


def frame_numbers(take: Take, first: int) -> Sequence[int]:
    """The numbers to write: those the take was read with, else counted up from ``first``."""
    numbers = take.extras.get("frame_numbers")
    if isinstance(numbers, torch.Tensor) and numbers.shape == (len(take),):
        return numbers.tolist()
    return range(first, first + len(take))
