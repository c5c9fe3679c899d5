"""What callers give (numbers, tensors, meshes, paths), checked in one way at the door."""

import math
import os
from numbers import Real
from typing import TypeVar

import numpy as np
import torch

from torchface.errors import ArgumentTypeError, FileFormatError, TopologyError, TorchfaceError, ValueRangeError

Kind = TypeVar("Kind")

LARGEST_WEIGHT = 1e12
"""The largest weight that a term of an energy may have: beyond it rounding leaves nothing of the other terms."""

LARGEST_SEED = 2**32 - 1  # what every generator of random numbers takes
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
        above: the range is open at ``least``.
    """
    number = _real(value)
    if not math.isfinite(number) or not least <= number <= most or (above and number == least):
        raise error(f"{name}: found {_shown(value)}, expected {_range_text('a finite number', least, most, above)}")
    return number


def checked_count(
    name: str, value: object, least: int = 0, most: int = 2**31 - 1, *, error: type[TorchfaceError] = ValueRangeError
) -> int:
    """The whole number itself, where it is in its range; as :func:`checked_number`, but 3.0 is no whole number."""
    fraction = isinstance(value, float) or (isinstance(value, torch.Tensor) and value.is_floating_point())
    if fraction or not least <= _real(value) <= most:
        found = f"{_shown(value)}.0" if fraction and _real(value) in range(10**6) else _shown(value)
        raise error(f"{name}: found {found}, expected {_range_text('a whole number', least, most)}")
    return int(_real(value))


def as_tensor(name: str, value: object, expected: str, dtype: torch.dtype | None = None) -> torch.Tensor:
    """The tensor itself; NumPy's arrays, and lists of numbers or of tensors of one shape, become one.

    Args:
        name: of the argument; begins the message.
        expected: the shape, such as ``(B,N)``.
        dtype: of what is converted; NumPy's own, and torch's default of lists, if absent.
    """
    if isinstance(value, torch.Tensor):
        return value
    made = None
    try:
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            unsigned = value.dtype.kind == "u" and value.dtype.itemsize > 1
            made = torch.from_numpy(np.array(value, dtype=np.int64 if unsigned else None, order="C"))
        elif isinstance(value, list | tuple) and value:
            stacked = all(isinstance(row, torch.Tensor) for row in value)
            made = torch.stack(list(value)) if stacked else torch.tensor(np.array(value).tolist())
    except (TypeError, ValueError, RuntimeError):  # of rows of other lengths, texts, objects
        made = None
    if made is None:
        raise ArgumentTypeError(f"{name}: found {_described(value)}, expected a tensor {expected}")
    if dtype is not None and not dtype.is_floating_point and made.is_floating_point():
        raise ArgumentTypeError(f"{name}: found floats, expected whole numbers {expected}")
    return made if dtype is None else made.to(dtype)


def checked_indices(name: str, value: object, count: int, error: type[TorchfaceError] = TopologyError) -> torch.Tensor:
    """The tensor itself, or one of a list or an array, where it is of whole numbers from 0 to below ``count``."""
    indices = as_tensor(name, value, "of whole numbers", torch.int64)
    if indices.dtype != torch.int64:
        raise error(f"{name}: found {indices.dtype}, expected torch.int64")
    if indices.numel() and (int(indices.min()) < 0 or int(indices.max()) >= count):
        raise error(f"{name}: found indices {int(indices.min())} to {int(indices.max())}, expected 0 to {count - 1}")
    return indices


_READ_BY = {
    "BlendshapeRig": "torchface.load_rig",
    "Mesh": "torchface.load_mesh",
    "Take": "torchface.load_take",
    "Attachment": "Attachment.load",
}


def checked_type(name: str, value: object, kind: type[Kind]) -> Kind:
    """The value itself, where it is of a class.

    Example:
        >>> checked_type("fps", "30", float)
        Traceback (most recent call last):
        torchface.errors.ArgumentTypeError: fps: found the text '30', expected a float
    """
    if isinstance(value, kind):
        return value
    article = "an" if kind.__name__[0] in "AEIO" else "a"
    path = isinstance(value, str | os.PathLike) and kind.__name__ in _READ_BY
    hint = f" ({_READ_BY[kind.__name__]} reads one from a file)" if path else ""
    raise ArgumentTypeError(f"{name}: found {_described(value)}, expected {article} {kind.__name__}{hint}")


def checked_path(name: str, value: object) -> None:
    """Raises ``ArgumentTypeError`` for what is no path."""
    if not isinstance(value, str | os.PathLike):
        raise ArgumentTypeError(f"{name}: found {_described(value)}, expected a path")


def _described(value: object) -> str:
    if value is None:
        return "None"
    if isinstance(value, str | os.PathLike):
        return f"the text {os.fspath(value)!r:.60}"
    if isinstance(value, torch.Tensor):
        return f"a tensor {tuple(value.shape)}"
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype}"
    if isinstance(value, list | tuple):
        kinds = sorted({type(row).__name__ for row in value})
        return f"a {type(value).__name__} of {', '.join(kinds[:3])}" if kinds else f"an empty {type(value).__name__}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    word = type(value).__name__
    return f"{'an' if word[0] in 'AEIOaeio' else 'a'} {word}"


def as_real(values: object, name: str = "values") -> torch.Tensor:
    """Whole numbers as floats of torch's default dtype: weights solved in an integer dtype would all be 0 or 1.

    NumPy's arrays and lists become tensors of that dtype, see :func:`as_tensor`.

    Example:
        >>> as_real(torch.tensor([3, 4])).is_floating_point()
        True
    """
    made = as_tensor(name, values, "of numbers", torch.get_default_dtype())
    return made if made.is_floating_point() or made.is_complex() else made.to(torch.get_default_dtype())


def check_rate(fps: object, where: str, error: type[TorchfaceError] = FileFormatError) -> float:
    """The rate itself, where it can be one of a camera's; ``where`` begins the message."""
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
    return f"{kind} {low}{most if isinstance(most, int) else f'{most:.7g}'}"


def _shown(value: object) -> str:
    if isinstance(value, torch.Tensor) and value.numel() == 1:
        value = value.item()
    number = _real(value)
    return repr(value)[:40] if math.isnan(number) and not isinstance(value, float) else f"{number:.7g}"
