"""Rotations filtered along time, as quaternions."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.temporal.kalman import KalmanFilter, KalmanSettings, kalman_smoother

_SHORTEST = 1e-6


class RotationFilter:
    """A causal filter of constant acceleration for unit quaternions.

    The four components are filtered as numbers and brought back to unit length; q and -q are the same rotation, so
    each measurement is taken with the sign that lies nearer to what is predicted.

    Args:
        settings: deviations of the quaternion's components (half the angle in radians) and gaps.

    Source: thesis 4.2.5.
    """

    def __init__(self, settings: KalmanSettings) -> None:
        self._filter = KalmanFilter(4, settings)

    def step(self, measured: Tensor) -> Tensor:
        """The filtered unit quaternion (4,) float64 after a measurement (4,); NaN for not seen.

        Raises:
            ShapeError: not (4,).
            ValueRangeError: infinite, or of no length.
        """
        _check(measured[None] if measured.ndim == 1 else measured)
        self._filter.to(measured.device).predict()
        predicted = self._filter.state[:, 0]
        unit = torch.nn.functional.normalize(measured.double(), dim=0)
        self._filter.correct(torch.where((unit * predicted).sum() < 0, -unit, unit))
        return torch.nn.functional.normalize(self._filter.state[:, 0], dim=0)


def filter_rotations(quaternions: Tensor, settings: KalmanSettings) -> Tensor:
    """Unit quaternions (T,4) from each frame and those before it; see :class:`RotationFilter`."""
    _check(quaternions)
    running = RotationFilter(settings)
    # A frame needs the one before.
    return torch.stack([running.step(frame) for frame in quaternions]).to(quaternions)


def smooth_rotations(quaternions: Tensor, settings: KalmanSettings) -> Tensor:
    """Unit quaternions (T,4) from all frames, those after each too."""
    _check(quaternions)
    return torch.nn.functional.normalize(kalman_smoother(aligned_signs(quaternions), settings), dim=1)


def aligned_signs(quaternions: Tensor) -> Tensor:
    """Unit quaternions (T,4) with the signs that make the shortest way from frame to frame, across gaps too."""
    unit = torch.nn.functional.normalize(quaternions, dim=1)
    seen = (~unit.isnan().any(1)).nonzero()[:, 0]
    if len(seen) < 2:
        return unit
    flips = torch.where((unit[seen[1:]] * unit[seen[:-1]]).sum(1) < 0, -1.0, 1.0)
    signs = torch.cat([flips.new_ones(1), flips.cumprod(0)]).to(unit)
    return unit.index_copy(0, seen, unit[seen] * signs[:, None])


def _check(quaternions: Tensor) -> None:
    if quaternions.ndim != 2 or quaternions.shape[1] != 4 or not len(quaternions):
        raise ShapeError(f"quaternions: found {tuple(quaternions.shape)}, expected (T,4) with a frame at least")
    length = quaternions.norm(dim=1)
    if length.isinf().any() or (length < _SHORTEST).any():
        raise ValueRangeError("quaternions: found one of no or infinite length, expected unit ones, or NaN")
