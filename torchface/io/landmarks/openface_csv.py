"""Landmark takes as CSV in OpenFace's layout: ``frame,timestamp,confidence,success,x_0,...,y_0,...``."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.io.tables.csv_table import TableReader, number_texts, quoted, write_table
from torchface.io.tables.frame_rates import frame_numbers
from torchface.io.tables.numbered_csv import openface_times
from torchface.io.tables.track_checks import kept_columns, values_to_write
from torchface.number_checks import check_rate
from torchface.take import Take, Track

_FRAME, _TIME, _CONFIDENCE, _SUCCESS = "frame", "timestamp", "confidence", "success"


def is_landmark_header(header: Sequence[str]) -> bool:
    """Whether a header is OpenFace's: a timestamp, and columns ``x_`` and ``y_``."""
    return _TIME in header and any(name.startswith("x_") for name in header)


def load_landmarks_csv(path: str | Path) -> Take:
    """Reads 2D landmarks as OpenFace writes them, (T,L,2) pixels, float32, with the frame's confidence for each.

    A landmark ``n`` is the columns ``x_n`` and ``y_n``; a frame of ``success`` 0 was not seen: NaN. Every other column
    (gaze, pose, 3D points, action units) is in ``extras["columns"]`` by name, (T,) float64. Frame numbers other than
    1, 2, ... are kept in ``extras["frame_numbers"]``, counted from 0; frames that come unevenly keep their times.

    Source: OpenFace wiki, "Output Format".
    """
    path = Path(path)
    reader = TableReader(path)
    names = tuple(name[2:] for name in reader.header if name.startswith("x_"))
    columns = [f"{axis}_{name}" for name in names for axis in "xy"]
    stray = sorted({name for name in reader.header if name.startswith("y_")} - {f"y_{name}" for name in names})
    if not names or stray:
        raise FileFormatError(
            f"{path}: found the columns {quoted(stray or reader.header)}, expected x_ and y_ of every landmark"
        )
    reader.require([_FRAME, _TIME, *columns])
    table = reader.read()
    times, extras = openface_times(table.column(_FRAME), table.column(_TIME), path)
    positions = table.columns(columns, np.float32).reshape(-1, len(names), 2)
    unseen = np.isnan(positions).any(2)
    if _SUCCESS in table.names:
        unseen |= (table.column(_SUCCESS) == 0)[:, None]
    positions[unseen] = np.nan
    used = {_FRAME, _TIME, _SUCCESS, _CONFIDENCE, *columns}
    others = {name: torch.from_numpy(table.column(name).copy()) for name in table.names if name not in used}
    confidence = None
    if _CONFIDENCE in table.names:
        confidence = torch.from_numpy(table.column(_CONFIDENCE).astype(np.float32))[:, None].repeat(1, len(names))
    track = Track(names, torch.from_numpy(positions), confidence)
    extras |= {"columns": others} if others else {}
    return Take(times.fps, landmarks=track, extras=extras, seconds=times.seconds)


def save_landmarks_csv(take: Take, path: str | Path) -> None:
    """Writes 2D landmarks (T,L,2), pixels, as OpenFace would have; a landmark that is NaN becomes empty cells.

    A frame's confidence is the mean over its landmarks, its success whether any was seen. The numbers in
    ``extras["columns"]`` follow.

    Source: OpenFace wiki, "Output Format".
    """
    path = Path(path)
    names, values = values_to_write(take.landmarks, "landmarks", 2, path)
    fps = check_rate(take.fps, f"{path}: the take", ValueRangeError)
    unseen = np.isnan(values).any(2)
    columns = {name: column for name, column in kept_columns(take, path).items() if isinstance(column, torch.Tensor)}
    header = [_FRAME, _TIME, _CONFIDENCE, _SUCCESS, *(f"{axis}_{name}" for axis in "xy" for name in names), *columns]
    if len(set(header)) < len(header):
        raise NameMismatchError(f"{path}: found a kept column named like another one, expected every name once")
    assert take.landmarks is not None
    confidence = take.landmarks.confidence
    level = torch.ones(len(take)) if confidence is None else confidence.detach().cpu().double().mean(1).float()
    numbers = frame_numbers(take, first=1)
    times = [(number - numbers[0]) / fps for number in numbers] if take.seconds is None else take.seconds.tolist()
    coordinates = [number_texts(values[:, :, axis].reshape(-1)) for axis in (0, 1)]
    others = [number_texts(column.detach().cpu().to(torch.float64).numpy()) for column in columns.values()]
    levels, width = number_texts(level.numpy()), len(names)
    rows = (
        [
            *(str(number), repr(times[row]), levels[row], str(int(not unseen[row].all()))),
            *(cell for cells in coordinates for cell in cells[row * width : (row + 1) * width]),
            *(cells[row] for cells in others),
        ]
        for row, number in enumerate(numbers)
    )
    write_table(path, header, rows)
