"""Action units in OpenFace's tables: ``frame,timestamp,...,AU01_r,...``."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from torchface.io.tables.csv_table import TableReader
from torchface.io.tables.numbered_csv import openface_times
from torchface.take import Take, Track

LARGEST_INTENSITY = 5.0  # of an action unit, as FACS' letters A to E

_INTENSITY = re.compile(r"AU\d\d_r")
_FRAME, _TIME, _SUCCESS = "frame", "timestamp", "success"


def is_action_unit_header(header: Sequence[str]) -> bool:
    """Whether a header is OpenFace's with intensities of action units."""
    return _FRAME in header and _TIME in header and any(map(_INTENSITY.fullmatch, header))


def load_action_units(path: str | Path) -> Take:
    """Reads intensities (``AU01_r``), 0 to 5, as weights 0 to 1, by OpenFace's names; presences (``AU01_c``) are none.

    A frame of ``success`` 0 showed no face: NaN.

    Source: OpenFace wiki, "Output Format".
    """
    path = Path(path)
    reader = TableReader(path)
    names = tuple(filter(_INTENSITY.fullmatch, reader.header))
    reader.require([_FRAME, _TIME, *names])
    table = reader.read()
    times, extras = openface_times(table.column(_FRAME), table.column(_TIME), path)
    weights = table.columns(names, np.float32) / LARGEST_INTENSITY
    if _SUCCESS in table.names:
        weights[table.column(_SUCCESS) == 0] = np.nan
    track = Track(names, torch.from_numpy(weights)[..., None])
    return Take(times.fps, weights=track, extras=extras, seconds=times.seconds)
