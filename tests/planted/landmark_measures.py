"""Measures of landmarks through a take: openings of lids and mouth, blinks, and how one signal follows another."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

# Upper and lower lid (right eye, then left) and inner lips, opposite each other.
_LIDS = (((37, 41), (38, 40)), ((43, 47), (44, 46)))
_LIPS = ((61, 67), (62, 66), (63, 65))
_CORNERS = (36, 45)


def lid_openings(landmarks: Tensor) -> Tensor:
    """How far each eye is open, over the distance of the outer corners of the eyes, (...,2), the right eye first.

    The mean distance of the upper lid's two landmarks (...,68,2) from the lower lid's, across the line through the
    eyes' outer corners; negative where the upper lid lies below the lower one, about 0.1 for open eyes from the front.

    Source: the eye aspect ratio of Soukupova and Cech 2016, over another width: that of one eye is less certain.
    """
    return torch.stack([_gap(landmarks, pairs) for pairs in _LIDS], -1)


def mouth_gap(landmarks: Tensor) -> Tensor:
    """How far the inner lips of landmarks (...,68,2) are apart, over that of the eyes' outer corners, (...,)."""
    return _gap(landmarks, _LIPS)


def find_blinks(openings: Tensor, closed: float = 0.7) -> Tensor:
    """First and last frame (N,2) int64 of runs in which the lids are nearer than they mostly are.

    Args:
        openings: of the lids, (T,); NaN for not seen, which ends a run.
        closed: a frame belongs to a blink where the opening is below so much of its median.
    """
    shut = torch.nn.functional.pad((openings < closed * openings.nanmedian()).to(torch.int8), (1, 1))
    change = shut.diff()
    return torch.stack([(change == 1).nonzero()[:, 0], (change == -1).nonzero()[:, 0] - 1], 1)


class Agreement(NamedTuple):
    """How a signal follows another: their correlation, and the slope of the first on the second.

    A slope below 1 says that the signal is damped: eyes that close half where they close in the reference.
    """

    correlation: float
    slope: float


def agreement(found: Tensor, reference: Tensor) -> Agreement:
    """Correlation and least-squares slope of what was found on a reference of the same shape; pairs with a NaN are left
    out; NaN both where fewer than three pairs are left or the reference does not change."""
    assert found.shape == reference.shape
    seen = torch.isfinite(found) & torch.isfinite(reference)
    x, y = reference[seen].double(), found[seen].double()
    if len(x) < 3:
        return Agreement(math.nan, math.nan)
    x, y = x - x.mean(), y - y.mean()
    spread, covariance = float(x.square().sum()), float((x * y).sum())
    if spread <= 0:
        return Agreement(math.nan, math.nan)
    return Agreement(covariance / math.sqrt(max(spread * float(y.square().sum()), 1e-300)), covariance / spread)


def _gap(landmarks: Tensor, pairs: tuple[tuple[int, int], ...]) -> Tensor:
    """Mean distance of lower from upper landmarks across the line of the eyes' outer corners, over its length."""
    along = landmarks[..., _CORNERS[1], :] - landmarks[..., _CORNERS[0], :]
    down = torch.stack([-along[..., 1], along[..., 0]], -1)
    upper, lower = (landmarks[..., [pair[side] for pair in pairs], :].mean(-2) for side in (0, 1))
    return ((lower - upper) * down).sum(-1) / along.square().sum(-1)
