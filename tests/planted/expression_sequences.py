"""Pieces of a take that go from rest to an expression and back: what a database of expressions is made of."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from torch import Tensor

_SMOOTHING = 0.1  # seconds
_PROMINENCE = 0.1  # of the range of a take's activity: what rises by less from both its valleys is no expression
_SHORTEST = 0.5  # seconds
_NOT_EXPRESSIONS = ("eyelook", "eyeblink")
_STILL = 1e-6  # sum of weights below which nothing moves


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
    """
    activity = _activity(weights, names, fps)
    span = float(np.ptp(activity)) if len(activity) else 0.0
    if span < _STILL:
        return ()
    # Quiet before the first frame and after the last: a take may begin or end in an expression.
    peaks = find_peaks(np.pad(activity, 1, constant_values=activity.min() - span), prominence=_PROMINENCE * span)[0] - 1
    stops = [0, *peaks.tolist(), len(activity)]
    valleys = [low + int(activity[low:high].argmin()) for low, high in pairwise(stops) if high > low]
    return tuple(slice(a, b) for a, b in pairwise(valleys) if b - a >= _SHORTEST * fps)


def _activity(weights: Tensor, names: Sequence[str], fps: float) -> NDArray[np.float64]:
    """The sum of the weights of each frame without gaze and blinks, (T,), smoothed by a tenth of a second."""
    counted = torch.tensor([not name.lower().startswith(_NOT_EXPRESSIONS) for name in names])
    total: NDArray[np.float64] = weights[:, counted].double().sum(1).cpu().numpy()
    return np.asarray(gaussian_filter1d(total, _SMOOTHING * fps)) if len(total) else total
