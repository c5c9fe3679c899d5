"""Values of frames that have none, from the frames before and after."""

import torch
from torch import Tensor

from torchface.errors import ShapeError


def interpolated(values: Tensor, rows: Tensor, frames: int) -> Tensor:
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
        >>> interpolated(torch.tensor([0.0, 1.0]), torch.tensor([1, 3]), frames=5).tolist()
        [0.0, 0.0, 0.5, 1.0, 1.0]
    """
    if not len(rows) or len(rows) != len(values):
        raise ShapeError(
            f"interpolated: found {len(values)} values of {len(rows)} frames, expected as many, at least one"
        )
    return values_at(values, rows, torch.arange(frames, device=rows.device))


def values_at(values: Tensor, seconds: Tensor, times: Tensor) -> Tensor:
    """Values (T,...) of frames shown at rising ``seconds`` (T,) at other ``times`` (S,), linear in between, (S,...).

    A value is NaN where one of the two frames beside it is NaN, and is the nearest frame's outside of them.
    """
    before, fraction = frames_beside(seconds, times)
    fraction = fraction.to(values).reshape(-1, *[1] * (values.ndim - 1))
    here, after = values[before], values[(before + 1).clamp(max=len(values) - 1)]
    return torch.where(fraction == 0, here, torch.where(fraction == 1, after, torch.lerp(here, after, fraction)))


def frames_beside(seconds: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Of each of ``times`` (S,) the frame before it, (S,) int64, and how far it is on to the next, (S,) in [0,1]."""
    seconds, times = seconds.double(), times.double()
    before = (torch.searchsorted(seconds, times, right=True) - 1).clamp(0, max(len(seconds) - 2, 0))
    length = seconds[(before + 1).clamp(max=len(seconds) - 1)] - seconds[before]
    return before, torch.where(length > 0, (times - seconds[before]) / length, 0.0).clamp(0, 1)


def nearest_rows(rows: Tensor, frames: int) -> Tensor:
    """Which of some frames (K,), rising, is nearest to each of all frames: indices into ``rows``, (T,) int64.

    Example:
        >>> nearest_rows(torch.tensor([0, 6]), frames=8).tolist()
        [0, 0, 0, 0, 1, 1, 1, 1]
    """
    before, fraction = frames_beside(rows, torch.arange(frames, device=rows.device))
    return before + (fraction > 0.5)
