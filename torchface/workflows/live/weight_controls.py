"""Settings of the page applied to solved weights, as ``export/web/src/weight_controls.js`` applies them there."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.shape_names import ARKIT
from torchface.workflows.live.live_frames import LiveFrame

_SLOWEST = 0.25  # seconds: the time constant of all smoothing
_MOST_GAIN, _MOST_DEAD = 10.0, 0.9


def _each(value: float) -> Tensor:
    return torch.full((len(ARKIT),), value)


@dataclass(frozen=True, eq=False)
class WeightSettings:
    """What the user set of each shape, and of the head."""

    gain: Tensor = field(default_factory=lambda: _each(1.0))  # factors, (52,); 0 for a shape that is muted
    dead: Tensor = field(default_factory=lambda: _each(0.0))  # weights below which a shape stays still, (52,) in [0,1)
    smoothing: Tensor = field(default_factory=lambda: _each(0.0))  # (52,) in [0,1]
    # of a head that looks into the camera, rig to camera, (3,3); as it is solved if absent
    rotation: Tensor | None = None
    gaze: Tensor | None = None  # of eyes that do, (2,2) radians
    frozen: bool = False  # hold the face as it is


class WeightControls:
    """Applies settings to one frame after another."""

    def __init__(self) -> None:
        self.settings = WeightSettings()
        self._before: LiveFrame | None = None

    def apply(self, solved: LiveFrame, interval: float | None) -> LiveFrame:
        r"""The frame as the user wants it.

        .. math:: w' = \mathrm{clip}\big(g \max(0, w - d) / (1 - d), 0, 1\big)

        .. math:: R' = R \, R_0^T \, \mathrm{diag}(1, -1, -1)
        """
        settings, before = self.settings, self._before
        if settings.frozen and before is not None:
            return replace(solved, weights=before.weights, rotation=before.rotation, gaze=before.gaze)
        weights = (settings.gain * (solved.weights - settings.dead).clamp(min=0) / (1 - settings.dead)).clamp(0, 1)
        if before is not None and interval is not None:
            slow = settings.smoothing > 0
            share = torch.where(slow, torch.exp(-interval / (_SLOWEST * settings.smoothing.clamp(min=1e-6))), 0.0)
            weights = weights + share * (before.weights - weights)
        rotation, gaze = solved.rotation, solved.gaze
        if settings.rotation is not None:
            rotation = rotation @ settings.rotation.T * torch.tensor([1.0, -1.0, -1.0])
        if settings.gaze is not None:
            gaze = gaze - settings.gaze
        self._before = replace(solved, weights=weights, rotation=rotation, gaze=gaze)
        return self._before


def read_weight_settings(found: Mapping[str, object]) -> WeightSettings:
    """Settings of a page's message."""
    centre = found.get("centre")
    rotation = gaze = None
    if isinstance(centre, Mapping):
        rotation = _numbers(centre.get("rotation"), 9, -1.1, 1.1).reshape(3, 3)
        gaze = _numbers(centre.get("gaze"), 4, -math.pi, math.pi).reshape(2, 2)
    count = len(ARKIT)
    return WeightSettings(
        _numbers(found.get("gain"), count, 0.0, _MOST_GAIN),
        _numbers(found.get("dead"), count, 0.0, _MOST_DEAD),
        _numbers(found.get("smoothing"), count, 0.0, 1.0),
        rotation,
        gaze,
        found.get("frozen") is True,
    )


def _numbers(values: object, count: int, least: float, most: float) -> Tensor:
    numbers = values if isinstance(values, list) else []
    if len(numbers) != count or not all(isinstance(one, int | float) and least <= one <= most for one in numbers):
        raise ValueRangeError(f"page: found {str(values)[:60]}, expected {count} numbers from {least} to {most}")
    return torch.tensor(numbers, dtype=torch.float32)
