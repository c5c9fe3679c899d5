"""Samples made of other samples: moved, a range of them, or all but one."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.sample_batches import Samples
from torchface.geometry.similarity import Similarity


@dataclass(frozen=True, eq=False)
class MovedSamples:
    """Samples (M,V,3), each moved by its own similarity of a batch of M."""

    samples: Samples
    poses: Similarity

    @property
    def shape(self) -> tuple[int, ...]:
        """M, V, C."""
        return self.samples.shape

    def read(self, begin: int, end: int) -> Tensor:
        """See :class:`Samples`."""
        read = self.samples.read(begin, end)
        return self.poses[begin:end].apply(read.double()).to(read)


@dataclass(frozen=True, eq=False)
class SampleRange:
    """Samples ``begin`` to ``end``, without the last, of others."""

    samples: Samples
    begin: int
    end: int

    @property
    def shape(self) -> tuple[int, ...]:
        """M, V, C."""
        return (self.end - self.begin, *self.samples.shape[1:])

    def read(self, begin: int, end: int) -> Tensor:
        """See :class:`Samples`."""
        return self.samples.read(self.begin + begin, self.begin + end)


@dataclass(frozen=True, eq=False)
class SamplesWithout:
    """All samples but one."""

    samples: Samples
    left_out: int

    @property
    def shape(self) -> tuple[int, ...]:
        """M, V, C."""
        return (self.samples.shape[0] - 1, *self.samples.shape[1:])

    def read(self, begin: int, end: int) -> Tensor:
        """See :class:`Samples`."""
        parts = [(begin, min(end, self.left_out)), (max(begin, self.left_out) + 1, end + 1)]
        read = [self.samples.read(first, last) for first, last in parts if first < last]
        return read[0] if len(read) == 1 else torch.cat(read)
