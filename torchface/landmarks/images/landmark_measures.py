"""What landmarks say of lids and mouth through a take, and how well two takes of landmarks agree about it."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError

# Upper and lower lid (right eye, then left) and inner lips, opposite each other.
_LIDS = (((37, 41), (38, 40)), ((43, 47), (44, 46)))
_LIPS = ((61, 67), (62, 66), (63, 65))
_CORNERS = (36, 45)


def lid_openings(landmarks: Tensor) -> Tensor:
    """How far each eye is open, over the distance of the outer corners of the eyes.

    The mean distance of the upper lid's two landmarks from the lower lid's, across the line through the eyes' outer
    corners; negative where the upper lid lies below the lower one.

    Args:
        landmarks: iBUG's 68, (...,68,2), pixels.

    Returns:
        (...,2), the person's right eye first; about 0.1 for an open eye of a face seen from the front.

    Raises:
        ShapeError: not (...,68,2).

    Source: the eye aspect ratio of Soukupova and Cech 2016, over another width: that of one eye is less certain.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> shut = rig.vertices + rig.deltas[rig.index(["eyeBlinkRight"])[0]]
        >>> right, left = lid_openings(shut[rig.neutral.landmarks][:, :2] * torch.tensor([1.0, -1.0]))
        >>> bool(right < 0.03 < left)
        True
    """
    return torch.stack([_gap(landmarks, pairs) for pairs in _LIDS], -1)


def mouth_gap(landmarks: Tensor) -> Tensor:
    """How far the inner lips are apart, over the distance of the outer corners of the eyes: (...,).

    Args:
        landmarks: iBUG's 68, (...,68,2), pixels.

    Raises:
        ShapeError: not (...,68,2).

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> wide = rig.vertices + rig.deltas[rig.index(["jawOpen"])[0]]
        >>> rest, gap = (mouth_gap(face[rig.neutral.landmarks][:, :2]) for face in (rig.vertices, wide))
        >>> bool(gap.abs() > rest.abs() + 0.1)
        True
    """
    return _gap(landmarks, _LIPS)


def find_blinks(openings: Tensor, closed: float = 0.7) -> Tensor:
    """Runs of frames in which the lids are nearer than they mostly are.

    Args:
        openings: of the lids, (T,); NaN for not seen, which ends a run.
        closed: a frame belongs to a blink where the opening is below so much of its median.

    Returns:
        First and last frame of each, (N,2) int64.

    Raises:
        ShapeError: not (T,).
        ValueRangeError: ``closed`` is not in (0,1).

    Example:
        >>> openings = torch.full((30,), 0.3)
        >>> openings[10:14] = 0.05
        >>> find_blinks(openings).tolist()
        [[10, 13]]
    """
    if openings.ndim != 1:
        raise ShapeError(f"openings: found {tuple(openings.shape)}, expected (T,)")
    if not 0 < closed < 1:
        raise ValueRangeError(f"closed: found {closed}, expected a share in (0,1)")
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
    """Correlation and least-squares slope of what was found on a reference.

    Args:
        found, reference: of as many values, such as openings (T,) or (T,2); pairs with a NaN are left out.

    Returns:
        NaN both where fewer than three pairs are left or the reference does not change.

    Raises:
        ShapeError: they differ in shape.

    Example:
        >>> reference = torch.tensor([0.1, 0.3, 0.2, 0.4])
        >>> found = agreement(0.5 * reference, reference)
        >>> round(found.correlation, 3), round(found.slope, 3)  # in step, and half as far
        (1.0, 0.5)
    """
    if found.shape != reference.shape:
        raise ShapeError(f"agreement: found {tuple(found.shape)} and {tuple(reference.shape)}, expected twice the same")
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
    if landmarks.shape[-2:] != (68, 2):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (...,68,2)")
    along = landmarks[..., _CORNERS[1], :] - landmarks[..., _CORNERS[0], :]
    down = torch.stack([-along[..., 1], along[..., 0]], -1)
    upper, lower = (landmarks[..., [pair[side] for pair in pairs], :].mean(-2) for side in (0, 1))
    return ((lower - upper) * down).sum(-1) / along.square().sum(-1)


def landmark_jitter(landmarks: Tensor) -> Tensor:
    r"""How much landmarks tremble, in pixels.

    .. math:: \sqrt{\tfrac16\, \operatorname{mean} (x_{t-1} - 2 x_t + x_{t+1})^2}

    over all coordinates: the standard deviation of white noise on a motion of constant velocity. What accelerates
    counts too, so that a still face tells it best.

    Args:
        landmarks: (T,L,2), pixels; NaN for not seen.

    Returns:
        A number; NaN where no landmark is seen in three frames in a row.

    Raises:
        ShapeError: not (T,L,2).

    Example:
        >>> steady = torch.arange(50.0)[:, None, None] * torch.ones(1, 68, 2)
        >>> landmark_jitter(steady).item()  # a constant speed is none
        0.0
    """
    if landmarks.ndim != 3 or landmarks.shape[2] != 2:
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (T,L,2)")
    second = (landmarks[2:] - 2 * landmarks[1:-1] + landmarks[:-2]).double()
    return (second.square().nanmean() / 6).sqrt()
