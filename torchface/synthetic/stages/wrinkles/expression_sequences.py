"""Pieces of a take that go from rest to an expression and back: what a database of expressions is made of."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.number_checks import check_rate

_SMOOTHING = 0.1  # seconds
_PROMINENCE = 0.2  # of the range of a take's activity: what rises by less from both its valleys is no expression
_SHORTEST, _LONGEST = 0.5, 8.0  # seconds
_NOT_EXPRESSIONS = ("eyelook", "eyeblink")


def expression_sequences(weights: Tensor, names: Sequence[str], fps: float) -> tuple[slice, ...]:
    """Pieces of a take from the quietest frame before an expression to the quietest after it, in order of time.

    Takes may hold no neutral frame, so a piece begins and ends in a valley of the sum of the weights; gaze and blinks
    do not count. Pieces do not overlap; those of less than half a second are no expression.

    Args:
        weights: of a take, (T,N).
        names: of its shapes.
        fps: frames a second.

    Returns:
        Slices of the frames, which may be none.

    Raises:
        ShapeError: ``weights`` are not (T,N) with one name a column.
        NameMismatchError: no shape but gaze and blinks.
        ValueRangeError: a weight is NaN or infinite, or ``fps`` is no rate.
    """
    check_rate(fps, "expression_sequences", ValueRangeError)
    _check(weights, len(names))
    counted = [not name.lower().startswith(_NOT_EXPRESSIONS) for name in names]
    if not any(counted):
        raise NameMismatchError(f"names: found {', '.join(names[:5])}, ...; expected shapes beside gaze and blinks")
    sum_of_weights = weights[:, torch.tensor(counted)].double().sum(1).cpu().numpy()
    activity = gaussian_filter1d(sum_of_weights, _SMOOTHING * fps)
    span = float(np.ptp(activity))
    if span < 1e-6:
        return ()
    peaks, _ = find_peaks(np.pad(activity, 1), prominence=_PROMINENCE * span)
    peaks = peaks - 1
    if len(peaks) == 0:
        return ()
    stops = [0, *peaks.tolist(), len(activity)]
    valleys = [low + int(activity[low:high].argmin()) if high > low else low for low, high in itertools.pairwise(stops)]
    valleys[-1] += 1  # the last frame belongs to the last piece
    pieces = itertools.pairwise(valleys)
    return tuple(slice(a, b) for a, b in pieces if _SHORTEST * fps <= b - a <= _LONGEST * fps)


def from_neutral_to_neutral(weights: Tensor, fps: float, seconds: float = 0.2) -> Tensor:
    """A piece of a take whose first and last frames are exactly neutral, (T,N): faded in and out, else as it was.

    Args:
        weights: (T,N), at least three frames.
        fps: frames a second.
        seconds: how long each fade lasts; at most a third of the piece.

    Raises:
        ShapeError: not (T,N), or fewer than three frames.
        ValueRangeError: a weight is NaN or infinite, or ``fps`` is no rate.
    """
    check_rate(fps, "from_neutral_to_neutral", ValueRangeError)
    _check(weights, weights.shape[-1])
    if len(weights) < 3:
        raise ShapeError(f"weights: found {len(weights)} frames, expected at least 3")
    length = min(max(1, math.ceil(seconds * fps)), max(1, len(weights) // 3))
    frame = torch.arange(len(weights), dtype=weights.dtype)
    rise = (torch.minimum(frame, len(weights) - 1 - frame) / length).clamp(max=1)
    return weights * (rise.square() * (3 - 2 * rise))[:, None]


def _check(weights: Tensor, count: int) -> None:
    if weights.ndim != 2 or weights.shape[1] != count:
        raise ShapeError(f"weights: found {tuple(weights.shape)}, expected (T,{count})")
    if not torch.isfinite(weights).all():
        raise ValueRangeError("weights: found NaN or infinite weights, expected finite ones; fill the gaps first")
