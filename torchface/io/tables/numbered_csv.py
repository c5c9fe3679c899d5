"""The plain CSV layout ``frame,time,<channel>,...``: one row a frame, times in seconds, an empty cell not seen."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchface.errors import FileFormatError, ValueRangeError
from torchface.io.tables.csv_table import Table, TableReader, number_texts, write_table
from torchface.io.tables.frame_rates import (
    FrameTimes,
    TimeSource,
    file_error,
    frame_numbers,
    frame_times,
    numbering_extras,
)
from torchface.number_checks import check_rate
from torchface.take import Take

COLUMNS = ("frame", "time")
UNKNOWN_RATE = 30.0  # frames a second of landmarks whose video's rate was not known to what found them

_OPENCV_RATE = 1000.0


def is_numbered(header: Sequence[str]) -> bool:
    """Whether a header is one of this layout."""
    return tuple(name.lower() for name in header[:2]) == COLUMNS


def read_numbered(reader: TableReader, texts: Sequence[str] = ()) -> tuple[Table, FrameTimes, dict[str, Any]]:
    """All rows, when their frames are shown, and what to keep of the frame numbers; the columns ``texts`` are kept as
    they stand.

    Numbers other than 0, 1, ... go to ``extras["frame_numbers"]``.
    """
    if not is_numbered(reader.header):
        raise FileFormatError(f"{reader.path}: found a header of other columns, expected it to begin with frame,time")
    table = reader.read(texts)
    times, extras = numbered_times(table.numbers[:, 0], table.numbers[:, 1], reader.path, first=0)
    return table, times, extras


def numbered_times(numbers: np.ndarray, times: np.ndarray, path: Path, first: int) -> tuple[FrameTimes, dict[str, Any]]:
    """When frames by numbers (T,) and times (T,) are shown, and what to keep of numbers other than ``first``, ..."""
    if not np.isfinite(times + numbers).all():
        row = int(np.flatnonzero(~np.isfinite(times + numbers))[0])
        raise FileFormatError(f"{path}: frame {row + 1}: found no frame number or no time, expected both in every row")
    extras = numbering_extras(numbers, first, str(path))
    return frame_times(times, TimeSource(file_error(path), numbers)), extras


def openface_times(numbers: np.ndarray, times: np.ndarray, path: Path) -> tuple[FrameTimes, dict[str, Any]]:
    """When frames by numbers (T,) and timestamps (T,) are shown, and what to keep of the numbers.

    Where a video's rate varies, OpenCV may say 1,000 frames a second, and OpenFace writes timestamps by it: then the
    rate is unknown, and :data:`UNKNOWN_RATE` is taken, with a ``UserWarning``.
    """
    found, extras = numbered_times(numbers, times, path, first=1)
    if found.fps != _OPENCV_RATE:
        return found, extras
    warnings.warn(
        f"{path}: found {_OPENCV_RATE:g} frames a second, which OpenCV says of videos whose rate it does not know, "
        f"expected a camera's; {UNKNOWN_RATE:g} are taken",
        stacklevel=3,
    )
    return numbered_times(numbers, numbers / UNKNOWN_RATE, path, first=1)


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
    times = [number / fps for number in numbers] if take.seconds is None else take.seconds.tolist()
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
