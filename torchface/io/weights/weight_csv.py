"""Blendshape weights as plain CSV: ``frame,time,<shape>,...``, with timecode and rotations where a take has them."""

from pathlib import Path

import numpy as np
import torch

from torchface.errors import FileFormatError, NameMismatchError
from torchface.io.markers.marker_csv import is_marker_header
from torchface.io.tables.csv_table import TableReader
from torchface.io.tables.numbered_csv import COLUMNS, read_numbered, write_numbered
from torchface.io.tables.track_checks import kept_columns, values_to_write
from torchface.take import Take, Track

ROTATIONS = tuple(part + axis for part in ("Head", "LeftEye", "RightEye") for axis in ("Yaw", "Pitch", "Roll"))
"""Live Link Face's nine columns behind the weights, radians."""

_TIMECODE = "timecode"


def load_weights_csv(path: str | Path) -> Take:
    """Reads weights, float32, from CSV with the header ``frame,time,<shape>,...``; names stay as the file spells them.

    One row a frame; times in seconds; an empty cell is NaN. The rate is that of numbers and times; frames that come
    unevenly keep their times. Numbers other than 0, 1, ... go to ``extras["frame_numbers"]``. A column ``timecode`` and
    head and eye rotations by Live Link Face's names (``HeadYaw``, ...) are no shapes: they go to ``timecode`` and to
    ``extras["columns"]``, where :func:`torchface.io.weights.live_link_csv.load_live_link` has them.
    """
    path = Path(path)
    reader = TableReader(path)
    if len(reader.header) < 3:
        raise FileFormatError(f"{path}: found {len(reader.header)} columns, expected frame,time,<shape>,...")
    if "" in reader.header:
        raise FileFormatError(f"{path}: found a column without a name, expected every shape's name in the header")
    table, times, extras = read_numbered(reader, [_TIMECODE] if _TIMECODE in reader.header else [])
    names = tuple(name for name in table.names[2:] if name not in ROTATIONS)
    if not names:
        raise FileFormatError(f"{path}: found no shape among the columns, expected frame,time,<shape>,...")
    columns = {name: torch.from_numpy(table.column(name).copy()) for name in table.names if name in ROTATIONS}
    values = torch.from_numpy(table.columns(names, np.float32))[..., None]
    return Take(
        times.fps,
        weights=Track(names, values),
        timecode=table.texts.get(_TIMECODE),
        extras=extras | ({"columns": columns} if columns else {}),
        seconds=times.seconds,
    )


def save_weights_csv(take: Take, path: str | Path) -> None:
    """Writes the weights of a take as CSV, all digits that float32 has; NaN becomes an empty cell.

    Timecode and head and eye rotations, where the take has them, come with them; what else it holds is left out.
    """
    path = Path(path)
    names, values = values_to_write(take.weights, "weights", 1, path)
    header = (*COLUMNS, *names)
    if is_marker_header(header) or set(names) & {*COLUMNS, _TIMECODE, *ROTATIONS}:
        raise NameMismatchError(f"{path}: found shapes named like other columns of the file, expected other names")
    rotations = {
        name: column.detach().cpu().double().numpy()
        for name, column in kept_columns(take, path).items()
        if name in ROTATIONS and isinstance(column, torch.Tensor)
    }
    timecode = {} if take.timecode is None else {_TIMECODE: take.timecode}
    write_numbered(take, path, names, values[..., 0], timecode, rotations)
