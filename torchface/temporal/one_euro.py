"""A causal low-pass filter that opens with speed: calm where a signal rests, quick where it moves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import check_rate, checked_number


@dataclass(frozen=True)
class OneEuroSettings:
    """How calm and how quick the filter is.

    Args:
        cutoff: of the low-pass at rest, Hz; less is calmer and later.
        speed: what the cutoff gains for each unit a second, Hz; more is quicker and rougher.
        speed_cutoff: of the low-pass on the speed itself, Hz.

    Example:
        >>> jump = torch.cat([torch.zeros(10), torch.ones(10)])
        >>> calm = one_euro_filter(jump, 60.0, OneEuroSettings(cutoff=0.5, speed=0.0))
        >>> quick = one_euro_filter(jump, 60.0, OneEuroSettings(cutoff=0.5, speed=10.0))
        >>> bool(calm[-1] < quick[-1])
        True
    """

    cutoff: float = 0.7
    speed: float = 3.0
    speed_cutoff: float = 1.0

    def __post_init__(self) -> None:
        for name in ("cutoff", "speed_cutoff"):
            checked_number(f"one-euro filter: {name}", getattr(self, name), above=True)
        checked_number("one-euro filter: speed", self.speed)


class OneEuroFilter:
    r"""Filters channels frame by frame, each from its own past alone.

    .. math:: \hat x_t = \hat x_{t-1} + \alpha(f_t)\,(x_t - \hat x_{t-1}), \quad f_t = f_0 + s\,|\hat{\dot x}_t|, \quad
        \alpha(f) = \Big(1 + \frac{r}{2 \pi f}\Big)^{-1}

    with the frame rate r and the speed :math:`\hat{\dot x}` filtered alike at a cutoff of its own. The defaults are for
    blendshape weights solved from markers.

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
        step = torch.where(known, values - self._value, 0.0)
        surprise = torch.where(known, step * self.fps - self._speed, 0.0)
        self._speed = self._speed + surprise * self._gain(self.settings.speed_cutoff)
        cutoff = self.settings.cutoff + self.settings.speed * self._speed.abs()
        first = torch.where(self._value.isnan(), values, self._value)
        self._value = first + step * self._gain(cutoff)
        return self._value.clone()

    def reset(self) -> None:
        """Forgets the frames before, as at the start of another take."""
        self._value = self._speed = None

    def _gain(self, cutoff):  # type: ignore[no-untyped-def]
        """What of a step is taken, of a number or of a tensor."""
        return 1 / (1 + self.fps / (2 * math.pi * cutoff))


def one_euro_filter(values: Tensor, fps: float, settings: OneEuroSettings = OneEuroSettings()) -> Tensor:
    """Each frame of (T,...) from itself and those before it.

    Example:
        >>> still = torch.full((5, 2), 0.25)
        >>> torch.equal(one_euro_filter(still, fps=60.0), still)
        True
    """
    running = OneEuroFilter(fps, settings)
    # A frame needs the one before.
    return torch.stack([running.step(frame) for frame in values])
