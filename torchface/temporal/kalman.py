"""Kalman filters and smoothers of constant acceleration, for signals that come frame by frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import as_real

# Deviation of the first velocity and acceleration, in measurement deviations a frame: nothing is known of them.
_FIRST_VELOCITY, _FIRST_ACCELERATION = 30.0, 30.0


@dataclass(frozen=True)
class KalmanSettings:
    r"""What a constant-acceleration filter assumes; time counts in frames.

    Args:
        measurement: deviation of the measurements, in their unit (pixels, millimetres).
        jerk: deviation of what the acceleration changes by in a frame, in that unit a frame². Small makes the filter
            smooth and slow, large quick and rough.
        longest_gap: frames without measurements that the causal filter bridges by prediction; then it waits for the
            next one and starts anew.
        damping: what is left of an acceleration after a frame; 1 is constant acceleration. What swings to and fro is
            predicted better with a little less, and does not run away in gaps.

    Example:
        >>> calm, quick = (KalmanFilter(1, KalmanSettings(measurement=1.0, jerk=jerk)) for jerk in (0.001, 1.0))
        >>> for frame in torch.cat([torch.zeros(20, 1), torch.ones(1, 1)]):
        ...     slow, soon = calm.step(frame), quick.step(frame)
        >>> bool(slow < soon)
        True
    """

    measurement: float
    jerk: float
    longest_gap: int = 10
    damping: float = 1.0

    def __post_init__(self) -> None:
        if not (0 < self.measurement < float("inf") and 0 < self.jerk < float("inf") and self.longest_gap >= 0):
            raise ValueRangeError(
                f"Kalman filter: found measurement {self.measurement}, jerk {self.jerk}, longest_gap "
                f"{self.longest_gap}, expected positive deviations and a gap from 0"
            )
        if not 0 <= self.damping <= 1:
            raise ValueRangeError(f"Kalman filter: found damping {self.damping}, expected 0 to 1")


class KalmanFilter:
    r"""A causal filter for C channels, one frame at a time.

    .. math:: x_t = F x_{t-1} + q, \quad z_t = p_t + r, \qquad
        F = \begin{pmatrix} 1 & 1 & \tfrac12 \\ & 1 & 1 \\ & & 1 \end{pmatrix}

    with position, velocity and acceleration :math:`x = (p, v, a)` of each channel on its own, and white jerk.

    Args:
        channels: C.
        settings: deviations and gaps, of all channels or one a channel.

    Raises:
        ShapeError: another number of settings than of channels.
        ValueRangeError: settings of different damping.

    Source: Kalman 1960; Singer 1970 for damping; thesis 4.2.5.

    Example:
        >>> smooth = KalmanFilter(channels=1, settings=KalmanSettings(measurement=0.5, jerk=0.01))
        >>> places = [smooth.step(torch.tensor([float(frame)])).item() for frame in range(30)]
        >>> round(smooth.step(torch.tensor([torch.nan])).item(), 1)
        30.0
    """

    def __init__(self, channels: int, settings: KalmanSettings | Sequence[KalmanSettings]) -> None:
        each = [settings] if isinstance(settings, KalmanSettings) else list(settings)
        if len(each) != channels and not isinstance(settings, KalmanSettings):
            raise ShapeError(f"Kalman filter: found {len(each)} settings, expected one or {channels}")
        self.state = torch.full((channels, 3), torch.nan, dtype=torch.float64)
        if len({one.damping for one in each}) > 1:
            raise ValueRangeError("Kalman filter: found settings of different damping, expected one for all channels")
        self._damping = each[0].damping
        # Channels of the same settings that were seen in the same frames have the same covariance: it is kept once.
        first: dict[KalmanSettings, int] = {}
        for channel, kind in enumerate(each):
            first.setdefault(kind, channel)
        kinds = list(first)
        row = {kind: number for number, kind in enumerate(kinds)}
        self.group = torch.tensor([row[one] for one in each]).expand(channels)
        """Which row of what is kept by group each channel has, (C,)."""
        self._first = torch.tensor(list(first.values()))
        self.variance = torch.tensor([kind.measurement**2 for kind in kinds], dtype=torch.float64)
        """Of the measurements, (G,)."""
        self.covariance = torch.zeros(len(kinds), 3, 3, dtype=torch.float64)
        """Of the states, (G,3,3)."""
        self._longest_gap = torch.tensor([kind.longest_gap for kind in kinds])
        self._unseen = torch.zeros(len(kinds), dtype=torch.int64)
        self._jerk = torch.tensor([kind.jerk**2 for kind in kinds], dtype=torch.float64)[:, None, None]
        self._go_on(1.0)

    def to(self, device: torch.device) -> "KalmanFilter":
        """The filter itself, with all that it holds on a device; ``step`` follows its measurements there."""
        if self.state.device != device:
            for name, value in vars(self).items():
                if isinstance(value, Tensor):
                    setattr(self, name, value.to(device))
        return self

    def predict(self, interval: float = 1.0) -> None:
        """Goes on to the next frame.

        Args:
            interval: since the frame before, in frames of the usual length.
        """
        if interval != self._interval:
            self._go_on(interval)
        self.state = self.state @ self._transition.T
        self.covariance = self._transition @ self.covariance @ self._transition.T + self._noise

    def _go_on(self, interval: float) -> None:
        transition, noise = _model(self._damping, interval)
        self._interval = interval
        self._transition = transition.to(self.state.device)
        self._noise = noise.to(self.state.device) * self._jerk

    def _split(self, seen: Tensor) -> None:
        """Parts groups of which some channels are seen (C,) and others are not."""
        parts, self.group = (2 * self.group + seen).unique(return_inverse=True)
        channels = torch.arange(len(seen), device=seen.device)
        self._first = channels.new_empty(len(parts)).scatter_(0, self.group, channels)
        for name in ("variance", "covariance", "_longest_gap", "_unseen", "_jerk", "_noise"):
            setattr(self, name, getattr(self, name)[parts // 2])

    def correct(self, measured: Tensor) -> None:
        """Takes in a frame's measurements (C,); NaN means not seen."""
        known = ~measured.isnan()
        if not torch.equal(known[self._first][self.group], known):
            self._split(known)
        seen = known[self._first]
        fresh = seen & self.state[self._first, 0].isnan()
        self._unseen = torch.where(seen, 0, self._unseen + 1)
        gain = self.covariance[:, :, 0] / (self.covariance[:, 0, 0] + self.variance)[:, None]
        gain = torch.where((seen & ~fresh)[:, None], gain, 0.0)
        each = gain[self.group]
        innovation = torch.where(each[:, 0] > 0, measured.double() - self.state[:, 0], 0.0)
        self.state = self.state + each * innovation[:, None]
        # Joseph's form stays symmetric and positive, whatever is rounded.
        keep = torch.eye(3, dtype=gain.dtype, device=gain.device) - gain[:, :, None] * gain.new_tensor([1.0, 0, 0])
        noise = self.variance[:, None, None] * gain[:, :, None] * gain[:, None]
        self.covariance = keep @ self.covariance @ keep.transpose(1, 2) + noise
        lost = self._unseen > self._longest_gap
        if bool(lost.any()) or bool(fresh.any()):
            first = torch.nn.functional.pad(measured.double()[:, None], (0, 2))
            kept = torch.where(lost[self.group, None], torch.nan, self.state)
            self.state = torch.where(fresh[self.group, None], first, kept)
            self.covariance = torch.where(fresh[:, None, None], _first_covariance(self.variance), self.covariance)

    def step(self, measured: Tensor) -> Tensor:
        """Filtered positions (C,) float64 after a frame's measurements (C,); NaN before the first and in long gaps.

        Raises:
            ShapeError: another number of channels.
            ValueRangeError: an infinite measurement.
        """
        if measured.shape != self.state.shape[:1]:
            raise ShapeError(f"Kalman filter: found {tuple(measured.shape)}, expected ({len(self.state)},)")
        if measured.isinf().any():
            raise ValueRangeError("Kalman filter: found an infinite measurement, expected numbers, or NaN for not seen")
        self.to(measured.device).predict()
        self.correct(measured)
        return self.state[:, 0].clone()


def kalman_smoother(
    values: Tensor, settings: KalmanSettings | Sequence[KalmanSettings], intervals: Sequence[float] | None = None
) -> Tensor:
    """Each frame from all frames, those after it too; for work that need not be live.

    Args:
        values: measurements (T,...), NaN for not seen.
        settings: see :class:`KalmanSettings`, of all channels or one a channel; all gaps are filled, whatever
            ``longest_gap`` is.
        intervals: from the frame before to each of T frames, in frames of the usual length; 1 if absent.

    Returns:
        Smoothed values of the same shape and dtype; NaN for a channel that was never seen, and before its first
        measurement.

    Source: Rauch, Tung, Striebel 1965.

    Example:
        >>> path = torch.linspace(0, 10, 11)[:, None]
        >>> path[4:7] = torch.nan
        >>> kalman_smoother(path, KalmanSettings(measurement=0.1, jerk=0.01))[4:7, 0].round(decimals=2).tolist()
        [4.0, 5.0, 6.0]
    """
    values = as_real(values)
    curves = _checked(values)
    frames = len(curves)
    given = [settings] if isinstance(settings, KalmanSettings) else settings
    each = [replace(one, longest_gap=frames) for one in given]
    running = KalmanFilter(curves.shape[1], each if given is settings else each[0])
    running.to(curves.device)
    predicted, filtered = [], []
    for frame, interval in zip(curves, intervals or [1.0] * frames, strict=True):
        running.predict(interval)
        predicted.append((running.state, running.covariance[running.group], running._transition))
        running.correct(frame)
        filtered.append((running.state, running.covariance[running.group]))
    state = filtered[-1][0]
    smoothed = [state[:, 0]]
    for (ahead, ahead_covariance, transition), (here, covariance) in zip(
        reversed(predicted[1:]), reversed(filtered[:-1]), strict=True
    ):
        gain = torch.linalg.solve(_regular(ahead_covariance), transition @ covariance).transpose(1, 2)
        moved = here + (gain @ (state - ahead)[..., None])[..., 0]
        # Where nothing was predicted, the channel is first seen in the next frame.
        state = torch.where(ahead[:, :1].isnan(), here, moved)
        smoothed.append(state[:, 0])
    return torch.stack(smoothed[::-1]).to(values.dtype).reshape(values.shape)


def _model(damping: float, interval: float) -> tuple[Tensor, Tensor]:
    """The transition over an interval in frames, and the covariance that white jerk adds, of deviation 1 in a frame."""
    h = interval
    transition = torch.tensor([[1, h, h**2 / 2], [0, 1, h], [0, 0, damping**h]], dtype=torch.float64)
    noise = [[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h]]
    return transition, torch.tensor(noise, dtype=torch.float64)


def _first_covariance(variance: Tensor) -> Tensor:
    """Covariances (G,3,3) at the first measurement, of these variances (G,)."""
    share = variance.new_tensor([1.0, _FIRST_VELOCITY**2, _FIRST_ACCELERATION**2])
    return torch.diag_embed(variance[:, None] * share)


def _regular(covariance: Tensor) -> Tensor:
    """Covariances (C,3,3) that can be inverted, also of channels not yet seen, which have none."""
    empty = (covariance[:, 0, 0] <= 0)[:, None, None]
    return torch.where(empty, torch.eye(3, dtype=covariance.dtype, device=covariance.device), covariance)


def _checked(values: Tensor) -> Tensor:
    if values.ndim == 0 or len(values) == 0:
        raise ShapeError(f"Kalman filter: found values {tuple(values.shape)}, expected (T,...) with a frame at least")
    if values.isinf().any():
        raise ValueRangeError("Kalman filter: found infinite measurements, expected numbers, or NaN for not seen")
    return values.detach().double().reshape(len(values), -1)
