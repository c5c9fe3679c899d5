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
class Aligned:
    """Neutrals (M,V,3) float64, aligned with each other."""

    neutrals: Samples  # (M,V,3)
    poses: Similarity  # of `align_neutrals`

    @property
    def shape(self) -> tuple[int, ...]:
        """M, V, 3."""
        return self.neutrals.shape

    def read(self, begin: int, end: int) -> Tensor:
        """See ``Samples``."""
        return _of(self.poses, begin, end).apply(self.neutrals.read(begin, end).double())


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
class Rows:
    """Some vertices of samples, (M,R,3) float32; whole samples are read a few at a time."""

    samples: Samples  # (M,V,3)
    rows: Tensor  # which, (R,)

    @property
    def shape(self) -> tuple[int, ...]:
        """M, R, 3."""
        return (self.samples.shape[0], len(self.rows), 3)

    def read(self, begin: int, end: int) -> Tensor:
        """See ``Samples``."""
        part = torch.empty(end - begin, *self.shape[1:])
        size = next(iter(blocks(self.samples)))[1]
        for first in range(begin, end, size):
            last = min(first + size, end)
            part[first - begin : last - begin] = self.samples.read(first, last)[:, self.rows]
        return part
