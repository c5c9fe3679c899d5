"""Checks of a take that is written to a file: values, names and kept columns."""

from pathlib import Path
from typing import Any

import numpy as np

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.io.tables.csv_table import quoted
from torchface.take import Take, Track

_BREAKS = frozenset("\0\t\n\r")


def values_to_write(track: Track | None, what: str, width: int, path: Path) -> tuple[tuple[str, ...], np.ndarray]:
    """Names and values (T,C,D) float32 of a take's track, if it has one; a channel with a NaN is NaN in all."""
    if track is None or track.values.shape[:2].numel() == 0:
        raise ValueRangeError(f"{path}: found a take without {what}, expected some to write")
    if track.values.shape[2] != width:
        raise ShapeError(f"{path}: found {what} {tuple(track.values.shape)}, expected (T,C,{width})")
    bad = [name for name in track.names if not name or name != name.strip() or _BREAKS & set(name) or not _utf8(name)]
    if bad:
        raise NameMismatchError(
            f"{path}: found the labels {quoted(bad)} of {what}; expected text that is not empty, neither begins nor "
            "ends in a blank, and holds no tab, line break or NUL"
        )
    values = track.values.detach().cpu().float().numpy().copy()
    if np.isinf(values).any():
        raise ValueRangeError(f"{path}: found infinite {what}, expected numbers, or NaN where not seen")
    values[np.isnan(values).any(2)] = np.nan
    return track.names, values


def kept_columns(take: Take, path: Path) -> dict[str, Any]:
    """The columns by name that a reader kept in ``extras``, each checked to have the take's length."""
    columns = take.extras.get("columns", {})
    wrong = [name for name, column in columns.items() if len(column) != len(take)]
    if wrong:
        raise ShapeError(
            f"{path}: found the kept columns {quoted(wrong)} of other lengths, expected {len(take)} frames"
        )
    return dict(columns)


def _utf8(name: str) -> bool:
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
