"""Frames of takes as priors learn from them: one take after the other, or some of all, never all at once."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError

MOST_FRAMES = 40_000  # what methods learn from that need all frames at once; of more, so many are drawn
_SHUFFLED = 2**22


@dataclass(frozen=True, eq=False)
class TakeFrames:
    """The frames in which every weight is known, of takes that are read anew each time."""

    takes: Sequence[Tensor]  # weights of each, (T,N); a list, or what reads them from a disk
    shapes: int  # N
    group: tuple[int, ...] | None = None  # columns that are wanted; all if absent

    def __iter__(self) -> Iterator[Tensor]:
        """Those of each take, (T,D) float64; takes of fewer than two are left out."""
        if not len(self.takes):
            raise ShapeError(f"prior: found no takes, expected (T,{self.shapes}) each")
        for take in map(torch.as_tensor, self.takes):
            if take.ndim != 2 or take.shape[1] != self.shapes:
                raise ShapeError(f"prior: found takes of {tuple(take.shape)}, expected (T,{self.shapes}) each")
            seen = take.detach().double()[torch.isfinite(take).all(1)]
            if len(seen) > 1:
                yield seen if self.group is None else seen[:, list(self.group)]

    def count(self) -> int:
        """How many frames there are."""
        total = sum(map(len, self))
        if not total:
            raise ValueRangeError("prior: found no two frames with all weights, expected takes to learn from")
        return total

    def some(self, most: int = MOST_FRAMES, seed: int = 0) -> Tensor:
        """All frames, (F,D), or ``most`` of them, drawn, in order."""
        total = self.count()
        if total <= most:
            return torch.cat(list(self))
        rows = drawn_rows(total, most, torch.Generator().manual_seed(seed)).sort().values
        parts, begin = [], 0
        for take in self:
            inside = (rows >= begin) & (rows < begin + len(take))
            parts.append(take[rows[inside] - begin])
            begin += len(take)
        return torch.cat(parts)


def drawn_rows(total: int, count: int, generator: torch.Generator) -> Tensor:
    """Different numbers below ``total`` in random order, (K,) int64, all of them if there are no more than ``count``.

    Of very many it needs no list of all.
    """
    if total <= max(_SHUFFLED, 8 * count):
        return torch.randperm(total, generator=generator)[:count]
    drawn = torch.randint(total, (2 * count + 64,), generator=generator)
    return torch.tensor(list(dict.fromkeys(drawn.tolist()))[:count])
