"""Landmarks of a face frame by frame, in tables of our own, OpenFace's, py-feat's, and of MediaPipe's mesh."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.io.tables.csv_table import Table, TableReader, quoted
from torchface.io.tables.frame_rates import numbering_extras
from torchface.io.tables.numbered_csv import openface_times

COUNTS = (68, 468, 478)  # points a frame: iBUG's landmarks; MediaPipe's mesh without and with irises

_POINT = re.compile(r"([xy])_?([0-9]{1,3})")
_LEVELS = ("confidence", "FaceScore")
_TIMES = ("timestamp", "time")
_FRAME, _SUCCESS, _PRESENCE = "frame", "success", "presence"
_SHARES = 8.0  # coordinates of a face that all lie below are no pixels
_MAX_FRAMES_A_ROW = 100


@dataclass(frozen=True, eq=False)
class LandmarkTable:
    """Landmarks of one face in all frames."""

    # (T,N,2) float32, NaN where not seen; pixels with centres at integers, or shares of the image's width and height.
    points: Tensor
    confidence: Tensor  # (T,N) in [0,1]
    visibility: Tensor  # (T,N) in [0,1]; 1 where the table does not say
    presence: Tensor  # (T,) in [0,1]; 1 where the table does not say, 0 where nothing is seen
    fps: float | None  # frames a second by the table's times, if it has any
    seconds: Tensor | None  # when each frame is shown, (T,) from 0, where they come unevenly
    shares: bool  # whether points are shares of the image

    def pixels(self, width: int, height: int) -> Tensor:
        """The points in an image's pixels (T,N,2)."""
        if not self.shares:
            return self.points
        return self.points * self.points.new_tensor([width, height]) - 0.5


def load_landmark_table(path: str | Path) -> LandmarkTable:
    """Reads landmarks that this toolkit or another program wrote as CSV.

    Columns ``x_0``, ``y_0``, ... or ``x0``, ``y0``, ... hold 68 landmarks, or 468 or 478 points of MediaPipe's mesh, in
    pixels or in shares of the image. ``frame`` puts rows in their place, frames between that are missing were not seen;
    ``success`` 0 was not seen either. ``confidence`` or py-feat's ``FaceScore`` say how sure a frame is,
    ``confidence_0``, ... and ``visibility_0``, ... each landmark, ``timestamp`` or ``time`` (seconds) the rate. Other
    columns are passed over.

    Source: OpenFace wiki, "Output Format"; py-feat's ``Fex``.
    """
    path = Path(path)
    reader = TableReader(path)
    columns = _point_columns(reader)
    count = len(columns) // 2
    each = {
        kind: [name for i in range(count) if (name := f"{kind}_{i}") in reader.header]
        for kind in ("confidence", "visibility")
    }
    singles = [name for name in (*_LEVELS, *_TIMES, _FRAME, _SUCCESS, _PRESENCE) if name in reader.header]
    table = reader.read(only=[*columns, *singles, *each["confidence"], *each["visibility"]])
    rows = _rows(table, path)
    total = int(rows[-1]) + 1
    points = np.full((total, count, 2), np.nan, np.float32)
    points[rows] = table.columns(columns, np.float32).reshape(-1, count, 2)
    unseen = np.asarray(np.isnan(points).any(2))
    if _SUCCESS in table.names:
        unseen[rows] |= (table.column(_SUCCESS) == 0)[:, None]
    points[unseen] = np.nan
    known = points[~unseen]
    confidence = np.zeros((total, count), np.float32)
    level = next((name for name in _LEVELS if name in table.names), None)
    confidence[rows] = 1 if level is None else _shares(table, [level], path)
    visibility, presence = np.ones((total, count), np.float32), np.ones(total, np.float32)
    if len(each["confidence"]) == count:
        confidence[rows] = _shares(table, each["confidence"], path)
    if len(each["visibility"]) == count:
        visibility[rows] = _shares(table, each["visibility"], path)
    if _PRESENCE in table.names:
        presence[rows] = _shares(table, [_PRESENCE], path)[:, 0]
    confidence[unseen], visibility[unseen], presence[unseen.all(1)] = 0, 0, 0
    shares = len(known) > 0 and float(np.abs(known).max()) < _SHARES
    fps, seconds = _times(table, rows, path)
    return LandmarkTable(
        torch.from_numpy(points),
        torch.from_numpy(confidence),
        torch.from_numpy(visibility),
        torch.from_numpy(presence),
        fps,
        seconds,
        shares,
    )


def _point_columns(reader: TableReader) -> list[str]:
    """The names of x and y of each point in turn."""
    columns: dict[tuple[str, int], str] = {}
    for name in reader.header:
        if match := _POINT.fullmatch(name):
            coordinate = (match[1], int(match[2]))
            if coordinate in columns:
                raise FileFormatError(
                    f"{reader.path}: found the columns {quoted([columns[coordinate], name])}, expected one"
                )
            columns[coordinate] = name
    count = len(columns) // 2
    wanted = [(axis, i) for i in range(count) for axis in "xy"]
    if count not in COUNTS or set(columns) != set(wanted):
        what = f"x and y of {count} points" if columns else f"the columns {quoted(reader.header)}"
        raise FileFormatError(
            f"{reader.path}: found {what}, expected x_0, y_0, ... of {COUNTS[0]} landmarks, or of {COUNTS[1]} or "
            f"{COUNTS[2]} points of MediaPipe's mesh, each number once from 0"
        )
    return [columns[coordinate] for coordinate in wanted]


def _rows(table: Table, path: Path) -> np.ndarray:
    """The frame, from 0, that each row is of."""
    if _FRAME not in table.names:
        return np.arange(len(table.numbers))
    numbers = table.column(_FRAME)
    same = np.flatnonzero(np.diff(numbers) == 0)
    if len(same):
        raise FileFormatError(
            f"{path}: found several rows of frame {numbers[same[0]]:.0f}, expected one: keep those of one face"
        )
    numbering_extras(numbers, first=0, where=str(path))
    first = 0 if numbers[0] == 0 or "FaceScore" in table.names else 1
    rows: np.ndarray = (numbers - first).astype(np.int64)
    if rows[-1] >= _MAX_FRAMES_A_ROW * len(rows):
        raise FileFormatError(
            f"{path}: found frame {numbers[-1]:.0f} in {len(rows)} rows, expected most frames to be there"
        )
    return rows


def _shares(table: Table, names: Sequence[str], path: Path) -> np.ndarray:
    """Columns that must lie in [0,1], (T,C); 0 where a cell is empty."""
    values = np.nan_to_num(table.columns(names, np.float32))
    if values.min() < 0 or values.max() > 1:
        raise FileFormatError(f"{path}: found {names[0]} from {values.min():g} to {values.max():g}, expected 0 to 1")
    return values


def _times(table: Table, rows: np.ndarray, path: Path) -> tuple[float | None, Tensor | None]:
    """Frames a second, and when all frames are shown where rows are not, of a table with times.

    Frames without a row are shown evenly between those beside them.
    """
    name = next((name for name in _TIMES if name in table.names), None)
    if name is None or len(rows) < 2:
        return None, None
    times = table.column(name)
    if not np.isfinite(times).any():
        return None, None
    found, _ = openface_times(rows + 1.0, times, path)
    if found.seconds is None or np.allclose(found.seconds.diff().numpy() * found.fps, np.diff(rows)):
        return found.fps, None  # dropped frames have rows of their own
    seconds = np.interp(np.arange(rows[-1] + 1), rows, found.seconds - found.seconds[0])
    before = (np.arange(rows[0]) - rows[0]) / found.fps
    seconds[: rows[0]] = before
    return found.fps, torch.from_numpy(seconds - seconds[0])
