"""Face Cap's text recordings: a line a frame, its time, head, eyes and ARKit's weights."""

from pathlib import Path

import numpy as np
import torch

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file
from torchface.io.tables.csv_table import MAX_TABLE_BYTES
from torchface.io.tables.frame_rates import TimeSource, file_error, frame_times
from torchface.io.weights.arkit_values import arkit_row, finite_number, rotations_of_degrees
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.take import Take, Track

FACE_CAP_ORDER: tuple[str, ...] = (
    *("browInnerUp", "browDownLeft", "browDownRight", "browOuterUpLeft", "browOuterUpRight", "eyeLookUpLeft"),
    *("eyeLookUpRight", "eyeLookDownLeft", "eyeLookDownRight", "eyeLookInLeft", "eyeLookInRight", "eyeLookOutLeft"),
    *("eyeLookOutRight", "eyeBlinkLeft", "eyeBlinkRight", "eyeSquintLeft", "eyeSquintRight", "eyeWideLeft"),
    *("eyeWideRight", "cheekPuff", "cheekSquintLeft", "cheekSquintRight", "noseSneerLeft", "noseSneerRight"),
    *("jawOpen", "jawForward", "jawLeft", "jawRight", "mouthFunnel", "mouthPucker", "mouthLeft", "mouthRight"),
    *("mouthRollUpper", "mouthRollLower", "mouthShrugUpper", "mouthShrugLower", "mouthClose", "mouthSmileLeft"),
    *("mouthSmileRight", "mouthFrownLeft", "mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight"),
    *("mouthUpperUpLeft", "mouthUpperUpRight", "mouthLowerDownLeft", "mouthLowerDownRight", "mouthPressLeft"),
    *("mouthPressRight", "mouthStretchLeft", "mouthStretchRight", "tongueOut"),
)
"""ARKit's 52 in the order in which Face Cap sends them by number."""

_TIME, _HEAD, _LEFT, _RIGHT, _WEIGHTS = 1, 5, 8, 10, 12  # columns of a line of a frame
_MOST_SHAPES, _MOST_LINE = 200, 2**13


def is_face_cap(line: str) -> bool:
    """Whether the first line of a file is Face Cap's."""
    return line.split(",", 1)[0].strip() in ("info", "bs", "k")


def load_face_cap(path: str | Path) -> Take:
    """Reads a recording.

    ``bs,<shape>,...`` names the shapes, in ARKit's spelling or with ``_L`` and ``_R``; each line ``k,...`` is a frame:
    milliseconds, the head's place (3) and degrees (3), of both eyes two degrees each, the weights. Other lines are
    passed over.

    Returns:
        weights (T,N,1), names as the file spells them; rotations in ``extras["columns"]``, radians.
    """
    path = Path(path)
    names: tuple[str, ...] = ()
    rows: list[list[float]] = []
    for number, line in enumerate(read_file(path, MAX_TABLE_BYTES).split(b"\n"), 1):
        where = f"{path}: line {number}"
        if len(line) > _MOST_LINE:
            raise FileFormatError(f"{where}: found {len(line)} bytes, expected at most {_MOST_LINE}")
        cells = [cell.strip() for cell in line.decode(errors="replace").strip().rstrip(",").split(",")]
        if cells[0] == "bs":
            if names or not all(cells[1:]) or len(set(cells)) < len(cells) or not 1 < len(cells) <= _MOST_SHAPES:
                raise FileFormatError(f"{where}: found {len(cells) - 1} shapes, expected names, each once, in one line")
            names = tuple(cells[1:])
        elif cells[0] == "k":
            if not names or len(cells) != _WEIGHTS + len(names):
                expected = f"{_WEIGHTS + len(names)} as the shapes need" if names else "the names of the shapes first"
                raise FileFormatError(f"{where}: found {len(cells)} cells, expected {expected}")
            rows.append([finite_number(cell, where) for cell in cells[1:]])
    if not rows:
        raise FileFormatError(f"{path}: found no frame, expected lines k,<milliseconds>,...")
    if not any(arkit_row(name) is not None for name in names):
        raise FileFormatError(f"{path}: found the shapes {', '.join(names[:5]):.80}, expected some of ARKit's")
    values = np.array(rows)
    seconds = values[:, _TIME - 1] / 1000
    times = frame_times(seconds, TimeSource(file_error(path), resolution=0.001, seconds=True))
    part = {name: values[:, at - 1 :] for name, at in (("head", _HEAD), ("left", _LEFT), ("right", _RIGHT))}
    turned = torch.stack(
        [
            rotations_of_degrees(head[:3].tolist(), left[:2].tolist(), right[:2].tolist())
            for head, left, right in zip(*part.values(), strict=True)
        ]
    ).double()
    columns = {name: turned[:, i].clone() for i, name in enumerate(ROTATIONS)}
    weights = torch.from_numpy(values[:, _WEIGHTS - 1 :].astype(np.float32))[..., None]
    return Take(times.fps, weights=Track(names, weights), extras={"columns": columns}, seconds=times.seconds)
