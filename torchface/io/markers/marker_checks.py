"""What all marker files have in common: units, labels, and what a take of markers must hold."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io.tables.csv_table import quoted
from torchface.take import Take, Track

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
"""Millimetres in each unit that marker files are written in."""

_SPELLINGS = {
    **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("centimeter", "centimeters", "centimetre", "centimetres"), "cm"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("inch", "inches"), "in"),
}


def millimetres(found: str, path: Path, field: str, unit: str | None) -> float:
    """Millimetres in a file's unit, or in the ``unit`` that the caller says it is.

    Raises:
        ValueRangeError: ``unit`` is none.
        FileFormatError: the file's is none, and the caller says nothing.
    """
    expected = ", ".join(UNITS)
    if unit is not None:
        if unit not in UNITS:
            raise ValueRangeError(f"unit: found {unit!r}, expected one of {expected}")
        return UNITS[unit]
    name = found.strip().lower()
    name = _SPELLINGS.get(name, name)
    if name not in UNITS:
        raise FileFormatError(f"{path}: {field}: found {quoted([found])}, expected one of {expected}; or give unit=")
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
    taken, seen, following, unique = set(filled), set(), dict.fromkeys(filled, 2), []
    for label in filled:
        name = label
        while name in seen or (name != label and name in taken):
            name = f"{label}_{following[label]}"
            following[label] += 1
        seen.add(name)
        unique.append(name)
    return tuple(unique)


def marker_take(path: Path, fps: float, labels: Sequence[str], values: np.ndarray, extras: dict[str, Any]) -> Take:
    """A take of markers (T,M,3) in millimetres as read from ``path``; a marker with a NaN coordinate was not seen.

    Raises:
        FileFormatError: there is no frame, no marker, or none was seen in any frame.
    """
    if values.shape[0] == 0 or values.shape[1] == 0:
        raise FileFormatError(
            f"{path}: found {values.shape[0]} frames of {values.shape[1]} points, expected at least one of each"
        )
    values = np.ascontiguousarray(values, np.float32)
    unseen = ~np.isfinite(values).all(2)
    if unseen.all():
        raise FileFormatError(
            f"{path}: found {values.shape[1]} points, none of them seen in any of {values.shape[0]} frames; "
            "expected at least one position"
        )
    values[unseen] = np.nan
    return Take(fps, markers=Track(tuple(labels), torch.from_numpy(values)), extras={"source": str(path), **extras})


def markers_to_write(take: Take, path: Path) -> tuple[tuple[str, ...], np.ndarray]:
    """Labels and positions (T,M,3) float32, a marker with a NaN coordinate NaN in all.

    Raises:
        ValueRangeError: the take has no markers or no frames, or a position is infinite.
        NameMismatchError: a label is empty or begins or ends in a blank, which files do not keep.
    """
    if take.markers is None or take.markers.values.shape[:2].numel() == 0:
        raise ValueRangeError(f"{path}: found a take without marker positions, expected some to write")
    if take.markers.values.shape[2] != 3:
        raise ShapeError(f"{path}: found markers {tuple(take.markers.values.shape)}, expected (T,M,3)")
    check_names(take.markers.names, path, "marker label")
    values = take.markers.values.detach().cpu().to(torch.float32).numpy().copy()
    if np.isinf(values).any():
        raise ValueRangeError(f"{path}: found an infinite marker position, expected numbers, or NaN where not seen")
    values[np.isnan(values).any(2)] = np.nan
    return take.markers.names, values


def check_names(names: Sequence[str], path: Path, kind: str) -> None:
    """Raises ``NameMismatchError`` for names that would not come back from a file as they are."""
    breaks = set("\0\t\n\r")
    bad = [name for name in names if not name or name != name.strip() or breaks & set(name) or not _is_unicode(name)]
    if bad:
        raise NameMismatchError(
            f"{path}: found the {kind} {quoted(bad)}; expected text that is not empty, "
            "neither begins nor ends in a blank, and holds no tab, line break or NUL"
        )


def _is_unicode(name: str) -> bool:
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
