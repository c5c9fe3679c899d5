"""Values of frames that have none, from the frames before and after."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import ShapeError


def bridged(values: Tensor, rows: Tensor, frames: int) -> Tensor:
    """Values of all frames from those of some, linear in between and held before the first and after the last.

    Args:
        values: (K,...), of the frames ``rows``.
        rows: (K,) int64, rising, at least one.
        frames: how many there are, T.

    Returns:
        (T,...); the frames ``rows`` keep their values bit for bit.

    Raises:
        ShapeError: there are no rows, or not as many as values.

    Example:
        >>> bridged(torch.tensor([0.0, 1.0]), torch.tensor([1, 3]), frames=5).tolist()
        [0.0, 0.0, 0.5, 1.0, 1.0]
    """
    if not len(rows) or len(rows) != len(values):
        raise ShapeError(f"bridged: found {len(values)} values of {len(rows)} frames, expected as many, at least one")
    every = torch.arange(frames, device=rows.device)
    before, after = _beside(rows, every)
    span = (rows[after] - rows[before]).clamp(min=1)
    share = ((every - rows[before]) / span).clamp(0, 1).to(values).reshape(-1, *[1] * (values.ndim - 1))
    return torch.lerp(values[before], values[after], share)


def nearest_rows(rows: Tensor, frames: int) -> Tensor:
    """Which of some frames (K,), rising, is nearest to each of all frames: indices into ``rows``, (T,) int64.

    Example:
        >>> nearest_rows(torch.tensor([0, 6]), frames=8).tolist()
        [0, 0, 0, 0, 1, 1, 1, 1]
    """
    every = torch.arange(frames, device=rows.device)
    before, after = _beside(rows, every)
    return torch.where((every - rows[before]).abs() <= (rows[after] - every).abs(), before, after)


def _beside(rows: Tensor, every: Tensor) -> tuple[Tensor, Tensor]:
    """Indices of the last row not after and the first not before each frame; the ends where there is none."""
    after = torch.searchsorted(rows, every).clamp(max=len(rows) - 1)
    before = (torch.searchsorted(rows, every, right=True) - 1).clamp(min=0)
    return before, after
