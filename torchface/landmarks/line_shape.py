"""How a line between two corners usually runs: learned from annotated ones, the start of tracing new ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

STATIONS = 17
_LEAST_SPREAD = 0.02  # of the length: corners are not found more exactly


@dataclass(frozen=True, eq=False)
class LineShape:
    """The usual course of a line, in shares of the length of its chord.

    Args:
        offset: how far below the chord the line runs at equal steps from its left to its right corner, (K,).
        spread: standard deviation of that, (K,).
    """

    offset: Tensor
    spread: Tensor

    @staticmethod
    def arc(sag: float, spread: float) -> LineShape:
        """A parabola that sags by a share of its length; 0 is the straight line."""
        along = torch.linspace(0, 1, STATIONS, dtype=torch.float64)
        return LineShape(4 * sag * along * (1 - along), torch.full((STATIONS,), spread, dtype=torch.float64))

    @staticmethod
    def fit(lines: Sequence[Tensor]) -> LineShape:
        """The mean course of pixel lines, each (N,2) from its left to its right corner; two lines at least."""
        rows = torch.stack([_offsets(line.double()) for line in lines])
        return LineShape(rows.mean(0), rows.std(0).clamp(min=_LEAST_SPREAD))

    def rows(self, left: Tensor, right: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Where the line is expected between two corners (2,): rows (N,) at columns (N,), and their spread, pixels."""
        left, right = left.double(), right.double()
        share = ((columns.double() - left[0]) / (right[0] - left[0])).clamp(0, 1)
        straight = left[1] + share * (right[1] - left[1])
        length = right[0] - left[0]
        return straight + length * _at(self.offset, share), length * _at(self.spread, share)


def _offsets(line: Tensor) -> Tensor:
    """Offsets (K,) of a line (N,2) below its chord, in chord widths, at equal steps of x."""
    order = line[:, 0].argsort()
    x, y = line[order, 0], line[order, 1]
    left, right = line[0], line[-1]
    wanted = left[0] + (right[0] - left[0]) * torch.linspace(0, 1, STATIONS, dtype=torch.float64)
    after = torch.searchsorted(x, wanted).clamp(1, len(x) - 1)
    share = ((wanted - x[after - 1]) / (x[after] - x[after - 1]).clamp(min=1e-9)).clamp(0, 1)
    row = y[after - 1] + share * (y[after] - y[after - 1])
    chord = torch.linspace(0, 1, STATIONS, dtype=torch.float64) * (right[1] - left[1]) + left[1]
    return (row - chord) / (right[0] - left[0])


def _at(values: Tensor, share: Tensor) -> Tensor:
    """Values (K,) at equal steps of [0,1], interpolated at shares (N,)."""
    values = values.double()
    place = share * (len(values) - 1)
    lower = place.floor().long().clamp(max=len(values) - 2)
    part = place - lower
    return values[lower] * (1 - part) + values[lower + 1] * part
