"""Samples of one form, read a few at a time from memory or from disk."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

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


def blocks(samples: Samples, largest: int = _BLOCK_BYTES) -> Iterator[tuple[int, int]]:
    """Begin and end of blocks that take at most ``largest`` bytes each in float64."""
    count, vertices, channels = samples.shape
    rows = max(1, largest // max(1, 8 * vertices * channels))
    for begin in range(0, count, rows):
        yield begin, min(begin + rows, count)
