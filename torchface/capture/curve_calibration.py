"""Correction of a person's weights from a phone or another tracker: what rests is taken off, what is weak is raised."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.shape_names import ARKIT

_LEARNED = 10.0  # seconds in which the face at rest is learned without being asked for
_MOST_SAMPLES = 600  # frames; then every other one goes
_OFTEN = 6  # frames between two looks at all of them
_MOST_REST, _REST_SHARE = 0.35, 0.2  # a face at rest has no more; so much of the time a shape is at rest
_MOST_GAIN, _HELD_SHARE, _LEAST_HELD = 2.5, 0.75, 0.2
_UNMOVED = ("eyeBlink", "eyeWide", "eyeLook")  # lids are scaled, and where eyes look is no matter of rest

HELD = {2: ("jawOpen",), 3: ("mouthSmile",), 4: ("browInnerUp", "browOuterUp"), 5: ("eyeBlink",)}
"""The shapes that each guided pose is to bring to 1, by the pose's number; pose 1 is the face at rest."""


@dataclass(frozen=True, eq=False)
class CurveCorrection:
    r"""Weights of a person as those of somebody who rests at 0 and reaches 1.

    .. math:: w' = g\,\frac{\max(0, w - r)}{1 - r}, \quad w' = g\,w \text{ of lids}

    Example:
        >>> correction = CurveCorrection(torch.full((52,), 0.2), torch.full((52,), 1.25))
        >>> [round(value, 3) for value in correction(torch.tensor([0.1, 0.6, 0.84] + [0.0] * 49))[:3].tolist()]
        [0.0, 0.625, 1.0]
    """

    rest: Tensor  # r, the person's weights at rest, (52,); 0 of lids and gaze
    gain: Tensor  # g, (52,)

    def __call__(self, weights: Tensor) -> Tensor:
        """Corrected weights (...,52), from 0 to 1."""
        return (self.gain * (weights - self.rest).clamp(min=0) / (1 - self.rest)).clamp(0, 1)


class CurveCalibration:
    """Learns a correction while frames come: rest in the first ten seconds or when asked for, gains of guided poses."""

    def __init__(self) -> None:
        self.correction = CurveCorrection(torch.zeros(len(ARKIT)), torch.ones(len(ARKIT)))
        self.seconds = 0.0
        self._samples: dict[int, list[Tensor]] = {}
        self._step = dict[int, int]()
        self._asked = False
        self._shifted = torch.tensor([not name.startswith(_UNMOVED) for name in ARKIT])

    @property
    def learned(self) -> float:
        """How far the person is learned, in [0,1]."""
        return 1.0 if self._asked else min(1.0, self.seconds / _LEARNED)

    @property
    def missed(self) -> tuple[int, ...]:
        """Guided poses that were asked for and not held."""
        return tuple(pose for pose in HELD if self._samples.get(pose) and not bool((self._held(pose) > 0).any()))

    def add(self, weights: Tensor, pose: int, interval: float) -> None:
        """Learns from a frame's weights (52,) and the pose asked for, 1 to 5 or 0 for none, ``interval`` seconds
        after the last."""
        if weights.shape != (len(ARKIT),):
            raise ShapeError(f"weights: found {tuple(weights.shape)}, expected ({len(ARKIT)},)")
        self.seconds += interval
        if pose == 1 and not self._asked:  # what was seen by the way counts no more
            self._asked = True
            self._samples.pop(0, None)
        if pose or (not self._asked and self.seconds <= _LEARNED):
            self._keep(pose, weights)
            if len(self._samples[pose]) % _OFTEN == 0:
                self._learn(pose)

    def _keep(self, pose: int, weights: Tensor) -> None:
        samples = self._samples.setdefault(pose, [])
        samples.append(weights.detach().float().cpu())
        if len(samples) > _MOST_SAMPLES:
            del samples[::2]

    def _learn(self, pose: int) -> None:
        rest, gain = self.correction.rest, self.correction.gain
        if pose <= 1:
            share, sure = (0.5, 1.0) if pose == 1 else (_REST_SHARE, self.learned)
            seen = torch.stack(self._samples[pose]).quantile(share, 0)
            rest = torch.where(self._shifted, sure * seen.clamp(0, _MOST_REST), 0.0)
        gain = torch.ones(len(ARKIT))
        for held in HELD:
            if self._samples.get(held):
                reached = ((self._held(held) - rest) / (1 - rest)).clamp(min=1e-3)
                gain = torch.where(self._held(held) > 0, (1 / reached).clamp(1, _MOST_GAIN), gain)
        self.correction = CurveCorrection(rest, gain)

    def _held(self, pose: int) -> Tensor:
        """What a pose's shapes reached while it was asked for, (52,); 0 of other shapes and those that did not move."""
        reached = torch.stack(self._samples[pose]).quantile(_HELD_SHARE, 0)
        own = torch.tensor([name.startswith(HELD[pose]) for name in ARKIT])
        return torch.where(own & (reached - self.correction.rest >= _LEAST_HELD), reached, 0.0)
