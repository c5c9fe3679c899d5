"""A causal low-pass filter that opens with speed: calm where a signal rests, quick where it moves."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import check_rate, checked_number


@dataclass(frozen=True)
class OneEuroSettings:
    """How calm and how quick the filter is; the defaults are for blendshape weights solved from markers.

    Args:
        cutoff: of the low-pass at rest, Hz; less is calmer and later.
        speed: what the cutoff gains for each unit a second, Hz; more is quicker and rougher.
        speed_cutoff: of the low-pass on the speed itself, Hz.

    Example:
        >>> calm, quick = OneEuroSettings(speed=0.0), OneEuroSettings(speed=10.0)
        >>> still, jump = torch.zeros(1), torch.ones(1)
        >>> (late, _), (soon, _) = (one_euro_step(jump, still, still, 1 / 60, each) for each in (calm, quick))
        >>> bool(late < soon)
        True
    """

    cutoff: float = 0.7
    speed: float = 3.0
    speed_cutoff: float = 1.0

    def __post_init__(self) -> None:
        for name in ("cutoff", "speed_cutoff"):
            checked_number(f"one-euro filter: {name}", getattr(self, name), above=True)
        checked_number("one-euro filter: speed", self.speed)


WEBCAM_ONE_EURO = OneEuroSettings(0.7, 2.0, 3.0)
"""Of weights and head solved from a webcam, by lag and tremor on rendered videos of the test takes: at equal tremor a
Kalman filter of constant acceleration comes four times as late."""


class OneEuroFilter:
    r"""Filters channels frame by frame, each from its own past alone.

    .. math:: \hat x_t = \hat x_{t-1} + \alpha(f_t)\,(x_t - \hat x_{t-1}), \quad f_t = f_0 + s\,|\hat{\dot x}_t|, \quad
        \alpha(f) = \Big(1 + \frac{r}{2 \pi f}\Big)^{-1}

    with the frame rate r and the speed :math:`\hat{\dot x}` filtered alike at a cutoff of its own.

    Args:
        fps: r, frames a second.
        settings: cutoffs.

    Raises:
        ValueRangeError: ``fps`` is no rate of a camera.

    Source: Casiez, Roussel, Vogel 2012.

    Example:
        >>> smooth = OneEuroFilter(fps=60.0)
        >>> _ = smooth.step(torch.tensor([0.0]))
        >>> 0 < smooth.step(torch.tensor([1.0])).item() < 1
        True
    """

    def __init__(self, fps: float, settings: OneEuroSettings = OneEuroSettings()) -> None:
        check_rate(fps, "one-euro filter", ValueRangeError)
        self.fps, self.settings = fps, settings
        self._value: Tensor | None = None
        self._speed: Tensor | None = None

    def step(self, values: Tensor) -> Tensor:
        """Filtered values after a frame's, of any one shape; a NaN leaves its channel as it was.

        Raises:
            ShapeError: another shape than the frame before.
        """
        if self._value is None or self._speed is None:
            self._value, self._speed = values.clone(), torch.zeros_like(values)
            return values.clone()
        if values.shape != self._value.shape:
            raise ShapeError(f"one-euro filter: found {tuple(values.shape)}, expected {tuple(self._value.shape)}")
        known = ~(values.isnan() | self._value.isnan())
        filtered, speed = one_euro_step(values, self._value, self._speed, 1 / self.fps, self.settings)
        self._speed = torch.where(known, speed, self._speed)
        self._value = torch.where(known, filtered, torch.where(self._value.isnan(), values, self._value))
        return self._value.clone()

    def reset(self) -> None:
        """Forgets the frames before, as at the start of another take."""
        self._value = self._speed = None


def one_euro_step(
    values: Tensor,
    before: Tensor,
    speed: Tensor,
    interval: Tensor | float,
    settings: OneEuroSettings,
    unit: Tensor | float = 1.0,
    opening: Tensor | float = 1.0,
) -> tuple[Tensor, Tensor]:
    """The next filtered values (...) and their speeds (...), a second; see :class:`OneEuroFilter`.

    A channel's ``unit`` counts as much as a value of 1; ``opening`` is a factor of the cutoff.
    """
    step = values - before
    speed = speed + (step / interval - speed) * _share_taken(settings.speed_cutoff, interval)
    cutoff = opening * (settings.cutoff + settings.speed * speed.abs() / unit)
    return before + step * _share_taken(cutoff, interval), speed


def _share_taken(cutoff: Any, interval: Tensor | float) -> Any:
    """What of a step a low-pass of a cutoff takes in an interval: of numbers or of tensors."""
    return 1 / (1 + 1 / (2 * math.pi * cutoff * interval))
