"""Numbers that callers give (settings, weights of terms, tolerances, counts, rates), checked in one way at the door."""

from __future__ import annotations

import math
from numbers import Real

import torch

from torchface.errors import FileFormatError, TorchfaceError, ValueRangeError

LARGEST_WEIGHT = 1e12
"""The largest weight that a term of an energy may have: beyond it rounding leaves nothing of the other terms."""

LARGEST_SEED = 2**32 - 1
"""What every generator of random numbers takes."""
MIN_FPS, MAX_FPS = 0.01, 10_000.0
"""Frames a second: from a picture every hundred seconds to what no marker camera reaches."""


def checked_number(
    name: str,
    value: object,
    least: float = 0.0,
    most: float = math.inf,
    *,
    above: bool = False,
    error: type[TorchfaceError] = ValueRangeError,
) -> float:
    """The number itself, where it is finite and in its range.

    Args:
        name: of the argument, setting or field; begins the message.
        value: an ``int``, a ``float``, one of numpy's, or a tensor of one number.
        least, most: the range.
        above: the range is open at ``least``.
        error: what is raised.

    Example:
        >>> checked_number("ridge", 0.5)
        0.5
        >>> checked_number("ridge", float("nan"))
        Traceback (most recent call last):
        torchface.errors.ValueRangeError: ridge: found nan, expected a finite number of at least 0
    """
    number = _real(value)
    if not math.isfinite(number) or not least <= number <= most or (above and number == least):
        raise error(f"{name}: found {_shown(value)}, expected {_range_text('a finite number', least, most, above)}")
    return number


def checked_count(
    name: str, value: object, least: int = 0, most: int = 2**31 - 1, *, error: type[TorchfaceError] = ValueRangeError
) -> int:
    """The whole number itself, where it is in its range.

    Args, Raises: as :func:`checked_number`; 3.0 is no whole number.

    Example:
        >>> checked_count("--port", 99999, 0, 65535)
        Traceback (most recent call last):
        torchface.errors.ValueRangeError: --port: found 99999, expected a whole number from 0 to 65535
    """
    fraction = isinstance(value, float) or (isinstance(value, torch.Tensor) and value.is_floating_point())
    if fraction or not least <= _real(value) <= most:
        raise error(f"{name}: found {_shown(value)}, expected {_range_text('a whole number', least, most)}")
    return int(_real(value))


def as_real(values: torch.Tensor) -> torch.Tensor:
    """Whole numbers as floats of torch's default dtype: weights solved in an integer dtype would all be 0 or 1.

    Example:
        >>> as_real(torch.tensor([3, 4])).is_floating_point()
        True
    """
    return values if values.is_floating_point() or values.is_complex() else values.to(torch.get_default_dtype())


def check_rate(fps: object, where: str, error: type[TorchfaceError] = FileFormatError) -> float:
    """The rate itself, where it can be one of a camera's; ``where`` begins the message.

    Raises:
        TorchfaceError: ``error``, for a rate that is no camera's.
    """
    number = _real(fps)
    if not MIN_FPS <= number <= MAX_FPS:
        raise error(f"{where}: found {fps!s:.40} frames a second, expected {MIN_FPS} to {MAX_FPS:.0f}")
    return number


def _real(value: object) -> float:
    """As a float; NaN for what is no number."""
    if isinstance(value, torch.Tensor) and value.numel() == 1 and value.dtype != torch.bool and not value.is_complex():
        return float(value)
    if isinstance(value, Real) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            return math.inf
    return math.nan


def _range_text(kind: str, least: float, most: float, above: bool = False) -> str:
    if math.isinf(most) or most == 2**31 - 1:
        return f"{kind} above {least:g}" if above else kind if math.isinf(least) else f"{kind} of at least {least:g}"
    low = f"above {least:g} and at most " if above else f"from {least:g} to "
    return f"{kind} {low}{most:.7g}"


def _shown(value: object) -> str:
    if isinstance(value, torch.Tensor) and value.numel() == 1:
        value = value.item()
    number = _real(value)
    return repr(value)[:40] if math.isnan(number) and not isinstance(value, float) else f"{number:.7g}"
