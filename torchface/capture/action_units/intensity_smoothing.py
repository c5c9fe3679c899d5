"""Steps of intensity, one a frame, made into curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.temporal import savitzky_golay

WINDOW = 25
"""Frames at 60 a second; a blink is over sooner than the others, so its window is the shortest."""

WINDOWS: dict[str, int] = {"45": 15, "7": 21, "6+43": 21, "18L": 29}
"""Windows of units that have their own."""

_RATE = 60.0
_MIN_WINDOW = 5


def smooth_intensities(
    intensities: Tensor,
    units: Sequence[str],
    windows: Mapping[str, int] = WINDOWS,
    order: int = 2,
    fps: float = _RATE,
) -> Tensor:
    """A classifier's levels as continuous curves in [0,1].

    Args:
        intensities: (T,A).
        units: their names, A.
        windows: of the Savitzky-Golay filter by unit, frames at 60 a second; ``WINDOW`` for the others.
        order: of its polynomial.
        fps: frames a second; a window lasts as long at any rate.

    Raises:
        ShapeError: ``intensities`` is not (T,A).

    Source: thesis 4.1.12.
    """
    if intensities.ndim != 2 or intensities.shape[1] != len(units):
        raise ShapeError(f"intensities: found {tuple(intensities.shape)}, expected (T,{len(units)})")
    frames = [max(round(windows.get(unit, WINDOW) * fps / _RATE), _MIN_WINDOW) for unit in units]
    curves = [savitzky_golay(intensities[:, a].double(), window, order) for a, window in enumerate(frames)]
    return torch.stack(curves, dim=1).clamp(0, 1).float()
