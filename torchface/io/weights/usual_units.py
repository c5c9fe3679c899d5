"""Weights in percent and rotations in degrees, as some programs write them, brought to 0 to 1 and to radians."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.io.weights.weight_csv import ROTATIONS
from torchface.take import Take, Track

LARGEST_WEIGHT = 5.0
"""Nobody drives a shape so far; where a tenth of the frames do, weights are in percent."""

LARGEST_ANGLE = math.pi
"""No rotation in radians is larger; where it is in a tenth of the frames, it is in degrees."""

_SHARE, _MOST_PERCENT, _MOST_DEGREES = 0.1, 200.0, 360.0


def in_usual_units(take: Take, path: Path) -> Take:
    """The take with weights from 0 to 1 and rotations in radians; what is converted, a ``UserWarning`` says."""
    if take.weights is not None and (most := _largest(take.weights.values.flatten(1), LARGEST_WEIGHT, _MOST_PERCENT)):
        _warn(path, f"weights up to {most:.4g}", "0 to 1", "percent")
        weights = Track(take.weights.names, take.weights.values / 100, take.weights.confidence)
        take = replace(take, weights=weights)
    columns = take.extras.get("columns", {})
    angles = {name: column for name, column in columns.items() if name in ROTATIONS and isinstance(column, Tensor)}
    if angles and (most := _largest(torch.stack(list(angles.values()), 1), LARGEST_ANGLE, _MOST_DEGREES)):
        _warn(path, f"head and eye rotations up to {most:.4g}", "radians", "degrees")
        columns = columns | {name: column * (math.pi / 180) for name, column in angles.items()}
        take = replace(take, extras=take.extras | {"columns": columns})
    return take


def _largest(values: Tensor, usual: float, most: float) -> float:
    """The largest of values (T,C), where many frames are beyond the usual and none beyond the unit's; else 0."""
    largest = values.abs().nan_to_num(0.0).amax(1) if values.numel() else values.new_zeros(1)
    beyond = float((largest > usual).double().mean())
    return float(largest.max()) if beyond >= _SHARE and float(largest.max()) <= most else 0.0


def _warn(path: Path, found: str, expected: str, taken: str) -> None:
    warnings.warn(f"{path}: found {found}, expected {expected}; they are taken for {taken}", stacklevel=4)
