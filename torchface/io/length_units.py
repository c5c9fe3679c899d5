"""Lengths in files: the unit they are in, and vertices that must be numbers."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import FileFormatError, ValueRangeError

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "um": 0.001}
"""Millimetres in each unit that files are written in."""


def millimetres_per(unit: str) -> float:
    """How many millimetres a file's unit has: one of ``UNITS``."""
    if unit not in UNITS:
        raise ValueRangeError(f"unit: found {unit!r}, expected one of {', '.join(map(repr, UNITS))}")
    return UNITS[unit]


def finite_vertices(path: Path, values: NDArray[np.float64]) -> Tensor:
    """Positions as float32; raises ``FileFormatError`` with the first one that is NaN or too large."""
    with np.errstate(over="ignore"):
        vertices = values.astype(np.float32)
    finite = np.isfinite(vertices)
    if not finite.all():
        bad = np.flatnonzero(~finite.all(1))
        raise FileFormatError(
            f"{path}: found NaN or infinity in {len(bad)} of {len(vertices)} vertices, first at {int(bad[0])}; "
            "expected finite numbers"
        )
    return torch.from_numpy(vertices)
