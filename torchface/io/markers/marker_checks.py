"""Checks of all marker files: units, labels, and the numbers of a take of markers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchface.errors import FileFormatError, ValueRangeError
from torchface.io.length_units import UNITS
from torchface.io.tables.csv_table import quoted
from torchface.io.tables.frame_rates import FrameTimes
from torchface.take import Take, Track

_SPELLINGS = {
    **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("centimeter", "centimeters", "centimetre", "centimetres"), "cm"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("inch", "inches"), "in"),
    **dict.fromkeys(("micrometer", "micrometers", "micrometre", "micrometres", "\u00b5m", "\u03bcm"), "um"),
}


def millimetres(file_unit: str, path: Path, field: str, unit: str | None) -> float:
    """Millimetres in a file's unit, or in the ``unit`` that the caller says it is."""
    expected = ", ".join(UNITS)
    if unit is not None:
        if unit not in UNITS:
            raise ValueRangeError(f"unit: found {unit!r}, expected one of {expected}")
        return UNITS[unit]
    name = file_unit.strip().lower()
    name = _SPELLINGS.get(name, name)
    if name not in UNITS:
        raise FileFormatError(
            f"{path}: {field}: found {quoted([file_unit])}, expected one of {expected}; or say it (--unit, unit=)"
        )
    return UNITS[name]


def unique_labels(labels: Sequence[str]) -> tuple[str, ...]:
    """Labels as recorders leave them, made distinct.

    An empty one becomes ``unlabeled`` and its channel's number (from 1); one that stood before gets ``_2``, ``_3``
    and so on, leaving out what another channel is called.

    Example:
        >>> unique_labels(["nose", "", "nose", "nose_2", "nose"])
        ('nose', 'unlabeled2', 'nose_3', 'nose_2', 'nose_4')
    """
    filled = [label or f"unlabeled{i + 1}" for i, label in enumerate(labels)]
    taken, used, following, unique = set(filled), set(), dict.fromkeys(filled, 2), []
    for label in filled:
        name = label
        while name in used or (name != label and name in taken):
            name = f"{label}_{following[label]}"
            following[label] += 1
        used.add(name)
        unique.append(name)
    return tuple(unique)


def marker_take(
    path: Path, times: FrameTimes, labels: Sequence[str], values: np.ndarray, extras: dict[str, Any], factor: float
) -> Take:
    """A take of markers (T,M,3) in millimetres, read from ``path`` in a unit of ``factor`` millimetres.

    A marker with a NaN coordinate was not seen, nor one at (0, 0, 0), which recorders write for it.
    """
    if values.shape[0] == 0 or values.shape[1] == 0:
        raise FileFormatError(
            f"{path}: found {values.shape[0]} frames of {values.shape[1]} points, expected at least one of each"
        )
    values = np.ascontiguousarray(values, np.float32)
    unseen = ~np.isfinite(values).all(2) | ~values.any(2)
    if unseen.all():
        raise FileFormatError(
            f"{path}: found {values.shape[1]} points, none of them seen in any of {values.shape[0]} frames; "
            "expected at least one position other than (0, 0, 0), which stands for not seen"
        )
    values[unseen] = np.nan
    markers = Track(tuple(labels), torch.from_numpy(values))
    unit = next(name for name, size in UNITS.items() if size == factor)
    extras = {"source": str(path), "unit": unit, **extras}
    return Take(times.fps, markers=markers, extras=extras, seconds=times.seconds)
