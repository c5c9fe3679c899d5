"""Samples of one form, read a few at a time: from memory, from disk, moved, or a range of others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchface.geometry.similarity import Similarity

_BLOCK_BYTES = 2**26


class Samples(Protocol):
    """Samples (M,V,C), such as a :class:`torchface.io.meshes.mesh_sequence.MeshSequence`."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def read(self, begin: int, end: int) -> Tensor:
        """Samples ``begin`` to ``end``, without the last, (N,V,C)."""
        ...


@dataclass(frozen=True, eq=False)
class SamplesInMemory:
    """A tensor (M,V,C)."""

    values: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        """M, V, C."""
        return tuple(self.values.shape)

    def read(self, begin: int, end: int) -> Tensor:
        """See :class:`Samples`."""
        return self.values[begin:end]


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


def blocks(samples: Samples, largest: int = _BLOCK_BYTES) -> Iterator[tuple[int, int]]:
    """Begin and end of blocks that take at most ``largest`` bytes each in float64."""
    count, vertices, channels = samples.shape
    rows = max(1, largest // (8 * vertices * channels))
    for begin in range(0, count, rows):
        yield begin, min(begin + rows, count)
