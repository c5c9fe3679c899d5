"""iFacialMocap's text: a line a frame, as the app sends it and as its recordings hold it."""

import re
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file
from torchface.io.tables.csv_table import MAX_TABLE_BYTES
from torchface.io.weights.arkit_values import arkit_row, finite_number, rotations_of_degrees
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT
from torchface.take import Take, Track

RATE = 60.0  # frames a second that the app sends; its text has no times

_MOST_FIELDS, _MOST_LINE = 400, 2**14
_SHAPE = re.compile(r"([A-Za-z]\w{1,39})[-&](-?[0-9.eE+-]+)")
_BONES = {"=head": 0, "head": 0, "leftEye": 1, "rightEye": 2}


def is_ifacialmocap(line: str) -> bool:
    """Whether a line is a frame of this text."""
    return "|" in line[:_MOST_LINE] and _SHAPE.fullmatch(line.split("|", 1)[0].strip()) is not None


def read_frame(text: str, where: str = "packet") -> tuple[Tensor, Tensor]:
    """Weights by ARKit's names (52,), 0 where the text has none, and Live Link Face's rotations (9,), radians.

    Args:
        text: ``jawOpen-12|eyeBlink_L-7|...|=head#x,y,z,px,py,pz|rightEye#x,y,z|leftEye#x,y,z|``, weights in percent
            behind ``-`` or, in the second version, ``&``; angles in degrees.

    Source: iFacialMocap, communication specifications, ifacialmocap.com/for-developer.
    """
    weights, angles, known = [0.0] * len(ARKIT), [[0.0] * 3 for _ in range(3)], 0
    fields = text[: _MOST_LINE + 1].split("|")
    if len(text) > _MOST_LINE or len(fields) > _MOST_FIELDS:
        raise FileFormatError(f"{where}: found {len(text)} letters, expected at most {_MOST_LINE} in a frame")
    for field in fields:
        field = field.strip()
        bone, mark, numbers = field.partition("#")
        if mark and bone in _BONES:
            values = [finite_number(number, where) for number in numbers.split(",")]
            if len(values) < 3:
                raise FileFormatError(f"{where}: found {len(values)} angles of {bone}, expected three")
            angles[_BONES[bone]] = values[:3]
        elif (shape := _SHAPE.fullmatch(field)) and (row := arkit_row(shape[1])) is not None:
            weights[row] = finite_number(shape[2], where) / 100
            known += 1
    if not known:
        raise FileFormatError(f"{where}: found none of ARKit's shapes, expected iFacialMocap's jawOpen-12|...")
    return torch.tensor(weights), rotations_of_degrees(*angles)


def load_ifacialmocap(path: str | Path) -> Take:
    """Reads a recording: a line a frame, 60 a second.

    Returns:
        weights (T,52,1) by ARKit's names; head and eye rotations in ``extras["columns"]``, radians.
    """
    path = Path(path)
    frames = []
    for number, line in enumerate(read_file(path, MAX_TABLE_BYTES).split(b"\n"), 1):
        if line.strip():
            try:
                text = line.decode()
            except UnicodeDecodeError as error:
                raise FileFormatError(
                    f"{path}: line {number}: found no UTF-8 ({error.reason}), expected text"
                ) from None
            frames.append(torch.cat(read_frame(text, f"{path}: line {number}")).numpy())
    if not frames:
        raise FileFormatError(f"{path}: found no line, expected a frame at least")
    values = np.stack(frames)
    columns = {name: torch.from_numpy(values[:, len(ARKIT) + i].astype(np.float64)) for i, name in enumerate(ROTATIONS)}
    weights = torch.from_numpy(values[:, : len(ARKIT), None].copy())
    return Take(RATE, weights=Track(ARKIT, weights), extras={"columns": columns})
