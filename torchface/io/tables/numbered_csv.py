"""The plain CSV layout ``frame,time,<channel>,...``: one row a frame, times in seconds, an empty cell not seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchface.errors import FileFormatError, ValueRangeError
from torchface.io.tables.csv_table import Table, TableReader, number_texts, write_table
from torchface.io.tables.frame_rates import DEFAULT_RATE, frame_numbers, numbering_extras, simplest_rate
from torchface.number_checks import check_rate
from torchface.take import Take

COLUMNS = ("frame", "time")
_FULL, _MILLISECONDS = 1e-9, 1e-3


def is_numbered(header: Sequence[str]) -> bool:
    """Whether a header is one of this layout."""
    return tuple(name.lower() for name in header[:2]) == COLUMNS


def read_numbered(reader: TableReader, texts: Sequence[str] = ()) -> tuple[Table, float, dict[str, Any]]:
    """All rows, the frame rate, and what to keep of the frame numbers; the columns ``texts`` are kept as they stand.

    The rate is that of the first and last row's numbers and times. Numbers other than 0, 1, ... go to
    ``extras["frame_numbers"]``, dropped frames as (row, how many) to ``extras["gaps"]``.
    """
    if not is_numbered(reader.header):
        raise FileFormatError(f"{reader.path}: found a header of other columns, expected it to begin with frame,time")
    table = reader.read(texts)
    frames, times = table.numbers[:, 0], table.numbers[:, 1]
    return table, rate_of(frames, times, reader.path), numbering_extras(frames, first=0, where=str(reader.path))


def rate_of(frames: np.ndarray, times: np.ndarray, path: Path) -> float:
    """Frames a second by frame numbers (T,) and times in seconds (T,)."""
    if not np.isfinite(times).all() or not np.isfinite(frames).all():
        row = int(np.flatnonzero(~np.isfinite(times + frames))[0])
        raise FileFormatError(f"{path}: frame {row + 1}: found no frame number or no time, expected both in every row")
    if len(times) == 1:
        return check_rate(frames[0] / times[0], str(path)) if times[0] > 0 and frames[0] > 0 else DEFAULT_RATE
    if np.any(np.diff(times) <= 0):
        row = int(np.flatnonzero(np.diff(times) <= 0)[0])
        raise FileFormatError(f"{path}: found time {times[row + 1]} after {times[row]}, expected rising times")
    count, duration = frames[-1] - frames[0], times[-1] - times[0]
    rate = check_rate(count / duration, f"{path}: times")
    for digits in (_FULL, _MILLISECONDS):  # trackers write times to the millisecond

        def agrees(other: float, digits: float = digits) -> bool:
            return bool(abs(count / other - duration) <= digits)

        if np.abs(np.rint(times / digits) * digits - times).max() <= _FULL * max(1.0, abs(times[-1])):
            simple = simplest_rate(rate, agrees)
            if simple != rate:
                return simple
    return rate


def write_numbered(
    take: Take,
    path: Path,
    names: Sequence[str],
    values: np.ndarray,
    before: Mapping[str, Sequence[str]] = {},
    behind: Mapping[str, np.ndarray] = {},
) -> None:
    """Writes columns (T,C), float32, with the take's frame numbers, or 0, 1, ... where it has none, and its times.

    Columns of texts, one a frame, stand before them, columns of numbers (T,) behind.
    """
    fps = check_rate(take.fps, f"{path}: the take", ValueRangeError)
    numbers = frame_numbers(take, first=0)
    seconds = take.uneven_seconds()
    times = [number / fps for number in numbers] if seconds is None else seconds.tolist()
    rows = (  # written as they are made: an hour's cells would fill the memory
        [
            str(number),
            repr(times[row]),
            *(texts[row] for texts in before.values()),
            *number_texts(values[row]),
            *number_texts(np.array([numbers[row] for numbers in behind.values()])),
        ]
        for row, number in enumerate(numbers)
    )
    write_table(path, [*COLUMNS, *before, *names, *behind], rows)
