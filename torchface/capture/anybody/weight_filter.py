"""Calms a webcam's weights and pose frame by frame, at whatever rate frames come."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchface.temporal.one_euro import OneEuroSettings

# By lag and tremor on rendered videos of the test takes: at equal tremor a Kalman filter of constant acceleration comes
# four times as late.
_CUTOFF, _OPENING, _SPEED_CUTOFF = 0.7, 2.0, 3.0
_OCTAVES = 4.0  # between no smoothing to speak of and the most, of the cutoff


def usual_filter() -> OneEuroSettings:
    """What :func:`one_euro_step` is at the usual smoothing of 0.5 for a unit of 1."""
    return OneEuroSettings(_CUTOFF, _OPENING, _SPEED_CUTOFF)


def one_euro_step(
    values: Tensor, before: Tensor, speed: Tensor, interval: Tensor, smoothing: Tensor, unit: Tensor
) -> tuple[Tensor, Tensor]:
    """The next filtered values (C,) and their speeds, as of ``torchface.temporal.OneEuroFilter``, by seconds.

    Args:
        values: of this frame, (C,).
        before, speed: filtered, of the frame before, (C,), and a second.
        interval: seconds since then, ().
        smoothing: () in [0,1]: 0 leaves the values as they are.
        unit: what counts as much as a weight of 1, (C,).
    """
    step = values - before
    speed = speed + (step / interval - speed) * _gain(_SPEED_CUTOFF * torch.ones_like(interval), interval)
    calm = torch.exp2(_OCTAVES * (0.5 - smoothing))
    cutoff = calm * (_CUTOFF + _OPENING * speed.abs() / unit)
    gain = torch.where(smoothing > 0, _gain(cutoff, interval), 1.0)
    return before + gain * step, speed


def _gain(cutoff: Tensor, interval: Tensor) -> Tensor:
    """What of a step is taken."""
    return 1 / (1 + 1 / (2 * math.pi * cutoff * interval))
