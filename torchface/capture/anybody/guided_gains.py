"""Gains of a person's groups of shapes relative to the rig, from poses that are asked for."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.capture.anybody.webcam_state import WebcamState
from torchface.shape_names import mapping

_GROUPS = (("jawOpen",), ("mouthSmileLeft", "mouthSmileRight"), ("browInnerUp", "browOuterUpLeft", "browOuterUpRight"))
_LEAST_GAIN, _MOST_GAIN = 0.6, 1.8
_REACTION, _GAIN_MEMORY, _ASKED = 0.8, 2.0, 0.25  # seconds, and the weight from which a pose counts as held
_RANGE_TIME = 2.0  # seconds in which a range grows that is left


def gain_groups(names: Sequence[str]) -> Tensor:
    """Which of N shapes each group holds, (G,N) float64: mouth open, smile, brows up."""
    return torch.stack([mapping(group, names).double().amax(1) for group in _GROUPS])


def gain_factors(gains: Tensor, groups: Tensor) -> Tensor:
    """Of each shape, (N,), of logarithms of the groups' gains (G,)."""
    return torch.exp(gains @ groups)


def highest_weights(factors: Tensor, groups: Tensor, pose: Tensor) -> Tensor:
    """How far weights may go before gains, (N,): a little beyond the person's known range, further if asked to."""
    asked = _asked(pose) @ groups
    grows = groups.amax(0)
    return torch.where(asked > 0, _MOST_GAIN, torch.where(grows > 0, 1.1 * factors.clamp(min=1.0), 1.0))


def learned_gains(
    weights: Tensor, groups: Tensor, before: WebcamState, interval: Tensor, pose: Tensor, learns: Tensor
) -> tuple[Tensor, Tensor]:
    """Logarithms of gains, and for how long each has been asked for, (G,)."""
    reached = (groups @ weights) / groups.sum(1)
    asked = learns * _asked(pose)
    seen = before.gains_seen + asked * interval
    held = asked * (seen > _REACTION) * (reached > _ASKED)
    since = (seen - _REACTION).clamp(min=0, max=_GAIN_MEMORY)
    aim = reached.clamp(_LEAST_GAIN, _MOST_GAIN).log()
    rate = held * (interval / (since + interval)) * torch.where(aim < before.gains, 0.5, 1.0)
    gains = before.gains + rate * (aim - before.gains)
    # Without being asked a range grows where it is left, and never shrinks.
    beyond = learns * (1 - asked) * (aim - gains).clamp(min=0) * (aim > 0)
    return gains + beyond * interval / _RANGE_TIME, seen


def _asked(pose: Tensor) -> Tensor:
    """Which groups of shapes a pose asks for, (G,)."""
    return ((pose - 2 - torch.arange(len(_GROUPS), device=pose.device)).abs() < 0.5).to(pose)
