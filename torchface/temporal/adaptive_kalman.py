"""A Kalman filter that finds its settings while it runs."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import as_real
from torchface.temporal.kalman import KalmanFilter, KalmanSettings, kalman_smoother


@dataclass(frozen=True)
class AdaptiveSettings:
    """The noises and motions that an adaptive filter reckons with; time counts in frames.

    Args:
        measurement: deviations of the measurements, in their unit.
        jerk: deviations of what the acceleration changes by in a frame, rising.
        damping: see :class:`KalmanSettings`.
        calm: share of each motion's credit that goes to the next calmer one: what is most likely still jitters more
            than eyes forgive, and a little calmer is hardly less exact.
        memory: frames after which a forecast counts 1/e.
        longest_gap: frames without measurements that are predicted; then the filter waits and starts anew.

    Example:
        >>> len(AdaptiveSettings(measurement=(0.5, 1.0), jerk=(0.01, 0.1, 1.0)).combinations())
        6
    """

    measurement: tuple[float, ...] = (0.2, 0.6, 1.5, 4.0)
    jerk: tuple[float, ...] = (0.003, 0.01, 0.033, 0.11, 0.36, 1.2)
    damping: float = 0.92
    calm: float = 0.3
    memory: float = 30.0
    longest_gap: int = 10

    def __post_init__(self) -> None:
        if not self.measurement or not self.jerk or list(self.jerk) != sorted(self.jerk):
            raise ValueRangeError(
                f"adaptive filter: found measurement {self.measurement} and jerk {self.jerk}, expected one at least, "
                "rising"
            )
        if not 0 <= self.calm <= 1 or not self.memory >= 1:
            raise ValueRangeError(
                f"adaptive filter: found calm {self.calm} and memory {self.memory}, expected 0 to 1 and at least 1 "
                "frame"
            )
        self.combinations()

    def combinations(self) -> list[KalmanSettings]:
        """Every measurement with every jerk, jerks running faster."""
        pairs = itertools.product(self.measurement, self.jerk)
        return [KalmanSettings(noise, jerk, self.longest_gap, self.damping) for noise, jerk in pairs]


# Lids and lips move more abruptly than a head does.
LANDMARK_SETTINGS = AdaptiveSettings(jerk=(0.003, 0.01, 0.033, 0.11, 0.36, 1.2, 4.0))
"""Of landmarks of a face some 100 to 600 pixels high, pixels."""


class AdaptiveFilter:
    r"""A causal filter for P points of D channels, as smooth as each point's noise and motion ask for.

    One :class:`KalmanFilter` runs for each combination of noise and motion, and each counts as much as it has
    predicted the last frames of the point well:

    .. math:: \hat x_t = \sum_m \omega_m \hat x_t^{(m)}, \qquad
        \omega_m \propto \prod_{s \le t} p(z_s \mid z_{<s}, m)^{(1 - 1/\tau)^{t-s}}

    Args:
        points, dimensions: P and D.
        settings: noises and motions.

    Source: Magill 1965; thesis 4.2.5.

    Example:
        >>> smooth = AdaptiveFilter(points=1, dimensions=2)
        >>> for frame in range(20):
        ...     place = smooth.step(torch.tensor([[5.0, 7.0]]))
        >>> place.round(decimals=2).tolist()
        [[5.0, 7.0]]
    """

    def __init__(self, points: int, dimensions: int, settings: AdaptiveSettings | None = None) -> None:
        self.settings = settings or AdaptiveSettings()
        self.shape = (points, dimensions)
        each = self.settings.combinations()
        self._models = len(each)
        self._filter = KalmanFilter(
            self._models * points * dimensions, [m for m in each for _ in range(points * dimensions)]
        )
        self.scores = torch.zeros(self._models, points, dtype=torch.float64)
        """What each model's forecasts of each point were worth, logarithms of probability, (M,P)."""

    def step(self, measured: Tensor, interval: float = 1.0) -> Tensor:
        """Filtered points (P,D) float64 after a frame's (P,D); NaN for not seen, and before the first and in long gaps.

        Args:
            measured: the frame's.
            interval: since the frame before, in frames of the usual length.

        Raises:
            ShapeError: another number of points.
            ValueRangeError: an infinite measurement.
        """
        if measured.shape != self.shape:
            raise ShapeError(f"adaptive filter: found {tuple(measured.shape)}, expected {self.shape}")
        if measured.isinf().any():
            raise ValueRangeError(
                "adaptive filter: found an infinite measurement, expected numbers, or NaN for not seen"
            )
        every = measured.double().flatten().repeat(self._models)
        self.scores = self.scores.to(measured.device)
        running = self._filter.to(measured.device)
        running.predict(interval)
        variance, group = running.covariance[:, 0, 0] + running.variance, running.group
        residual = every - running.state[:, 0]
        certainty = -0.5 * (residual.square() / variance[group] + variance.log()[group])
        known = ~residual.isnan()
        gained = torch.where(known, certainty, 0.0).reshape(self._models, *self.shape).sum(-1)
        fade = torch.where(known.reshape(self._models, *self.shape).any(-1), 1 - 1 / self.settings.memory, 1.0)
        self.scores = fade * self.scores + gained
        running.correct(every)
        states = running.state[:, 0].reshape(self._models, *self.shape)
        return (self._model_weights()[..., None] * states).sum(0)

    def _model_weights(self) -> Tensor:
        """How much each model counts for each point, (M,P)."""
        likely = torch.softmax(self.scores, dim=0).reshape(-1, len(self.settings.jerk), self.shape[0])
        calmer = torch.cat([likely[:, 1:], torch.zeros_like(likely[:, :1])], dim=1)
        calmer[:, 0] += likely[:, 0]
        return torch.lerp(likely, calmer, self.settings.calm).flatten(0, 1)


def adaptive_filter(
    values: Tensor, settings: AdaptiveSettings | None = None, intervals: Sequence[float] | None = None
) -> Tensor:
    """Points (T,P,D), NaN for not seen, each frame from itself and those before; see :class:`AdaptiveFilter`.

    ``intervals`` are T, each from the frame before, in frames of the usual length; 1 if absent.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> noisy = torch.randn(200, 1, 2, generator=generator)
        >>> bool(adaptive_filter(noisy)[50:].std() < 0.5 * noisy[50:].std())
        True
    """
    values = _checked(values)
    running = AdaptiveFilter(values.shape[1], values.shape[2], settings)
    # A frame needs the one before.
    steps = zip(values, intervals or [1.0] * len(values), strict=True)
    return torch.stack([running.step(frame, interval) for frame, interval in steps]).to(values.dtype)


def adaptive_smoother(
    values: Tensor, settings: AdaptiveSettings | None = None, intervals: Sequence[float] | None = None
) -> Tensor:
    """Points (T,P,D) from all frames, those after each too, under the noise and motion that are most likely of each.

    Gaps are filled up to ``longest_gap`` frames; longer ones, and what is before the first measurement, stay NaN.
    ``intervals`` are T, each from the frame before, in frames of the usual length; 1 if absent.

    Source: Rauch, Tung, Striebel 1965.

    Example:
        >>> path = torch.linspace(0, 10, 40)[:, None, None].repeat(1, 1, 2)
        >>> path[20:23] = torch.nan
        >>> round(adaptive_smoother(path)[21, 0, 0].item(), 1)
        5.4
    """
    values = _checked(values)
    chosen = settings or AdaptiveSettings()
    points, dimensions = values.shape[1:]
    endless = replace(chosen, calm=0.0, memory=float("inf"), longest_gap=len(values))
    running = AdaptiveFilter(points, dimensions, endless)
    intervals = intervals or [1.0] * len(values)
    for frame, interval in zip(values, intervals, strict=True):  # a frame needs the one before
        running.step(frame, interval)
    combinations = chosen.combinations()
    each = [combinations[m] for m in running.scores.argmax(0).tolist() for _ in range(dimensions)]
    return torch.where(_long_gaps(values, chosen.longest_gap), torch.nan, kalman_smoother(values, each, intervals))


def _long_gaps(values: Tensor, longest: int) -> Tensor:
    """Where (T,P,D) is NaN for more than ``longest`` frames in succession."""
    unseen = values.isnan()
    frames = torch.arange(len(values), device=values.device).reshape(-1, 1, 1)
    last = torch.where(unseen, -1, frames).cummax(0).values
    following = torch.where(unseen, len(values), frames).flip(0).cummin(0).values.flip(0)
    return unseen & (following - last - 1 > longest)


def _checked(values: Tensor) -> Tensor:
    values = as_real(values)
    if values.ndim != 3 or not len(values):
        raise ShapeError(f"adaptive filter: found values {tuple(values.shape)}, expected (T,P,D) with a frame at least")
    return values
