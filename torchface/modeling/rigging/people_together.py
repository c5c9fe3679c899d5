"""People with expressions, aligned with each other as they are read."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.sample_batches import Samples, blocks
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.modeling.rigging.expression_regression import Form

_ROUNDS = 4


def align_neutrals(neutrals: Samples) -> tuple[Tensor, Similarity]:
    """Mean (V,3) of neutrals (M,V,3) aligned with it, and each one's rigid pose, float64."""
    count, _, channels = neutrals.shape
    if count < 2 or channels != 3:
        raise ShapeError(f"neutrals: found {tuple(neutrals.shape)}, expected (M,V,3) of at least two people")
    first = neutrals.read(0, 1)[0].double()
    mean = first - first.mean(0)
    for _ in range(_ROUNDS):
        poses, total = [], torch.zeros_like(mean)
        for begin, end in blocks(neutrals):
            points = neutrals.read(begin, end).double()
            if not bool(torch.isfinite(points.sum())):
                bad = (~torch.isfinite(points)).flatten(1).any(1).nonzero()[:, 0] + begin
                raise ValueRangeError(f"neutrals: number {int(bad[0])} holds NaN or infinity; expected none")
            poses.append(similarity_transform(points, mean.expand_as(points), scale=False))
            total += poses[-1].apply(points).sum(0)
        mean = total / count
    return mean, Similarity(*(torch.cat([getattr(p, name) for p in poses]) for name in _POSE))


_POSE = ("scale", "rotation", "translation")


def _of(poses: Similarity, begin: int, end: int) -> Similarity:
    return Similarity(*(getattr(poses, name)[begin:end] for name in _POSE))


@dataclass(frozen=True, eq=False)
class NeutralRegion:
    """The part of each neutral that is learned from, (M,R,3) float32, aligned with the others."""

    neutrals: Samples  # (M,V,3)
    poses: Similarity  # of `align_neutrals`
    rows: Tensor  # which vertices, (R,)

    @property
    def shape(self) -> tuple[int, ...]:
        """M, R, 3."""
        return (self.neutrals.shape[0], len(self.rows), 3)

    def read(self, begin: int, end: int) -> Tensor:
        """See ``Samples``."""
        part = torch.empty(end - begin, *self.shape[1:])
        for first, last in _within(self.neutrals, begin, end):
            aligned = _of(self.poses, first, last).apply(self.neutrals.read(first, last).double())
            part[first - begin : last - begin] = aligned[:, self.rows]
        return part


@dataclass(frozen=True, eq=False)
class Predicted:
    """What is to be predicted of each person, (M,N·V,3) float64: offsets or expressions, turned as the neutral is."""

    neutrals: Samples  # (M,V,3)
    expressions: Samples  # (M,N·V,3)
    poses: Similarity  # of `align_neutrals`
    form: Form  # "offsets" or "expressions"

    @property
    def shape(self) -> tuple[int, ...]:
        """M, N·V, 3."""
        return self.expressions.shape

    def read(self, begin: int, end: int) -> Tensor:
        """See ``Samples``."""
        shown, poses = self.expressions.read(begin, end).double(), _of(self.poses, begin, end)
        if self.form == "expressions":
            return poses.apply(shown)
        neutral = self.neutrals.read(begin, end).double()
        offsets = shown.view(len(shown), -1, *neutral.shape[1:]) - neutral[:, None]
        return offsets.flatten(1, 2) @ poses.rotation.double().transpose(-1, -2)


@dataclass(frozen=True, eq=False)
class MovingPlaces:
    """Those places of what is to be predicted that someone moves, (M,P,3) float32."""

    predicted: Predicted  # (M,N·V,3)
    places: Tensor  # which rows, (P,)

    @property
    def shape(self) -> tuple[int, ...]:
        """M, P, 3."""
        return (self.predicted.shape[0], len(self.places), 3)

    def read(self, begin: int, end: int) -> Tensor:
        """See ``Samples``."""
        part = torch.empty(end - begin, *self.shape[1:])
        for first, last in _within(self.predicted, begin, end):
            part[first - begin : last - begin] = self.predicted.read(first, last)[:, self.places]
        return part


def _within(samples: Samples, begin: int, end: int) -> list[tuple[int, int]]:
    """Blocks of whole samples between two numbers: what is wanted of them may be a small part."""
    rows = next(iter(blocks(samples)))[1]
    return [(first, min(first + rows, end)) for first in range(begin, end, rows)]
