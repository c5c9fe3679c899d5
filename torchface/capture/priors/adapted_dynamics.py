"""A dynamics prior for other shape names and another frame rate than those that it has learned."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchface.capture.energy import Quadratic, gaussian_term
from torchface.capture.priors.dynamics_prior import DynamicsPrior
from torchface.capture.priors.motion_features import newest_frames, same_rate
from torchface.capture.priors.name_translation import name_matrices, require_same_names
from torchface.errors import FileFormatError, ValueRangeError
from torchface.optim.full_precision import full_precision

_MAX_RATIO = 8.0


class AdaptedDynamicsPrior(nn.Module):
    r"""Mean and variance of the next frame, for another rig's names and another frame rate.

    A window is translated into the learned names, interpolated at the learned frame rate and carried forward by as
    many learned steps as a frame lasts; a last part of a step moves the mean by a part. The predicted change comes back
    in the rig's names. The deviation of a step grows over the steps that follow it as the steps' own autoregression
    says, and those of all steps, which err in the same direction, add up:

    .. math:: \sqrt V = \sum_k |h_{K-k}| \sqrt{V_k}, \qquad h_0 = 1, \quad h_k = h_{k-1} + \sum_i a_{J-i} h_{k-1-i}

    A shape that the learned names do not have is predicted to stay, with the mean variance of the others.

    Args:
        learned: the prior as learned.
        names: of the rig's N shapes.
        fps: frames a second of the windows.

    Raises:
        NameMismatchError: too few of the rig's shapes are among those learned.
        ValueRangeError: ``fps`` is not within a factor of 8 of the learned rate.

    Source: thesis 4.2.10, for one rate and one set of names.

    Example:
        >>> from torchface import zoo
        >>> learned = zoo.get_model("dynamics_prior").double()
        >>> at_24 = AdaptedDynamicsPrior(learned, ["jawOpen", "tongueOut"], fps=24.0)
        >>> mean, variance = at_24(torch.full((1, at_24.window, 2), 0.3, dtype=torch.float64))
        >>> round(mean[0, 1].item(), 3)  # not learned, so it stays
        0.3
    """

    to_learned: Tensor
    from_learned: Tensor
    interpolation: Tensor
    unknown: Tensor

    def __init__(self, learned: DynamicsPrior, names: Sequence[str], fps: float) -> None:
        super().__init__()
        ratio = learned.fps / fps if fps > 0 else math.inf
        if not 1 / _MAX_RATIO <= ratio <= _MAX_RATIO:
            raise ValueRangeError(
                f"dynamics prior: found {fps:g} frames a second, expected from {learned.fps / _MAX_RATIO:g} to "
                f"{learned.fps * _MAX_RATIO:g} for a prior learned at {learned.fps:g}"
            )
        if same_rate(learned.fps, fps):
            ratio = 1.0
        there, back = name_matrices(learned.names, names)
        self.learned, self.names, self.fps = learned, tuple(names), float(fps)
        self.steps = math.ceil(ratio - 1e-9)
        self.last_part = ratio - (self.steps - 1)
        self.window = math.ceil((learned.window - 1) / ratio - 1e-9) + 1
        like = learned.center
        interpolation = _interpolation(learned.window, self.window, ratio)
        self.register_buffer("to_learned", there.to(like), persistent=False)
        self.register_buffer("from_learned", back.to(like), persistent=False)
        self.register_buffer("unknown", (~back.any(1)).to(like), persistent=False)
        self.register_buffer("interpolation", interpolation.to(like), persistent=False)

    @property
    def center(self) -> Tensor:
        """Of the learned prior: its dtype and device are this one's."""
        return self.learned.center

    @full_precision
    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the next frame.

        Args:
            windows: the last frames, the newest last, (B,J',N); of more than J the last J count.

        Returns:
            (B,N) and (B,N).

        Raises:
            ShapeError: fewer frames than the window, or another number of shapes.
        """
        windows = newest_frames(windows, self.window, len(self.names))
        frames = torch.einsum("kj,bjn,ln->bkl", self.interpolation, windows, self.to_learned)
        last = before = frames[:, -1]
        variances: list[Tensor] = []
        for _ in range(self.steps):  # a step starts from the one before
            before = frames[:, -1]
            mean, variance = self.learned(frames)
            frames = torch.cat([frames[:, 1:], mean[:, None]], dim=1)
            variances.append(variance)
        mean = torch.lerp(before, frames[:, -1], self.last_part)
        deviation = _carried(variances, _growth(self.learned.coefficients, self.steps))
        ahead = windows[:, -1] + (mean - last) @ self.from_learned.T
        # The halves of a shape err together, so deviations add up and not variances.
        variance = (deviation @ self.from_learned.T).square()
        variance = variance + self.unknown * (variance.sum(1, keepdim=True) / (1 - self.unknown).sum())
        return ahead.clamp(self.learned.limits[0], self.learned.limits[1]), variance

    def energy(self, windows: Tensor) -> Quadratic:
        """How unlikely the next weights are; see ``DynamicsPrior.energy``."""
        return gaussian_term(*self(windows))

    def require(self, names: Sequence[str]) -> None:
        """Raises ``NameMismatchError`` where a rig's shapes are not ``names``."""
        require_same_names(self.names, names)

    @property
    def config(self) -> dict[str, Any]:
        """From which :meth:`from_config` makes a prior for the state to be loaded into."""
        return {"learned": self.learned.config, "names": list(self.names), "fps": self.fps}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "AdaptedDynamicsPrior":
        """A prior that has learned nothing, with the sizes of a ``config``.

        Raises:
            FileFormatError: a part of it is not what it should be.
        """
        try:
            return cls(DynamicsPrior.from_config(config["learned"]), config["names"], float(config["fps"]))
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(f"dynamics prior: found a config without a usable {error}, expected one") from error

    def check_state(self) -> None:
        """Refuses a state that no fit gives; see ``DynamicsPrior.check_state``."""
        self.learned.check_state()


def adapt_dynamics(
    prior: DynamicsPrior | AdaptedDynamicsPrior, names: Sequence[str], fps: float | None = None
) -> DynamicsPrior | AdaptedDynamicsPrior:
    """The prior for a rig's names and a video's frame rate: itself where both are its own.

    Args:
        prior: as learned, or adapted before.
        names: of the rig's shapes.
        fps: frames a second of the video; the prior's own if absent.

    Raises:
        NameMismatchError: too few of the rig's shapes are among those learned.
        ValueRangeError: ``fps`` is not within a factor of 8 of the learned rate.

    Example:
        >>> from torchface import zoo
        >>> learned = zoo.get_model("dynamics_prior")
        >>> adapt_dynamics(learned, learned.names) is learned, adapt_dynamics(learned, ["jawOpen"], fps=24.0).fps
        (True, 24.0)
    """
    learned = prior.learned if isinstance(prior, AdaptedDynamicsPrior) else prior
    rate = prior.fps if fps is None else fps
    if tuple(names) == learned.names and same_rate(learned.fps, rate):
        return learned
    return AdaptedDynamicsPrior(learned, names, rate)


def _interpolation(learned: int, window: int, ratio: float) -> Tensor:
    """Rows (J,J') that read a window of J learned frames off J' frames that are ``ratio`` learned frames long."""
    place = (window - 1) - torch.arange(learned - 1, -1, -1, dtype=torch.float64, device="cpu") / ratio
    frames = torch.arange(window, dtype=torch.float64, device="cpu")
    return (1 - (place[:, None] - frames).abs()).clamp(min=0)


def _growth(coefficients: Tensor, steps: int) -> Tensor:
    """How a deviation of the first frame has grown after 0, 1, ... steps, (K,N); h of the class's formula."""
    rows = [torch.ones_like(coefficients[0])]
    for k in range(1, steps):  # a recursion over a few steps
        pulls = [coefficients[-1 - i] * rows[k - 1 - i] for i in range(min(k, len(coefficients)))]
        rows.append(rows[-1] + torch.stack(pulls).sum(0))
    return torch.stack(rows)


def _carried(variances: list[Tensor], growth: Tensor) -> Tensor:
    """The standard deviation (B,N) after steps of these variances, the first one first."""
    return (growth[: len(variances)].flip(0).abs()[:, None] * torch.stack(variances).sqrt()).sum(0)
