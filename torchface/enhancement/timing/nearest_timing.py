"""The timing of a motion between two keyframes by its nearest captured motions: a path in order through each."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import isotonic_regression
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import checked_count

NEAREST = 8
_STILL = 1e-3  # share of the whole motion below which a region counts as at rest
_DRIFT = 0.05  # share of a sequence's range by which an extended motion may go back before it counts as another
_DETOUR = 0.5  # what a captured way costs that is longer than the straight one, a length of distance
_WAIT = 1e-6  # of the asked motion's size: what a frame costs, which decides between poses that are equal
_LITTLE = 0.1  # of the asked motion's size: a captured motion that is smaller may be noise
_ONE_WAY = 0.5  # of how far a motion goes from its first pose: how far its last pose is at least
_HOLD = 0.01  # share of the range within which the face counts as held


def nearest_timing(
    keyframes: Tensor,
    captured: Sequence[Tensor],
    region: Tensor,
    frames: int,
    length: float,
    nearest: int = NEAREST,
    extend: bool = True,
) -> Tensor:
    """How far a region's motion between two keyframes has come in each frame, by its nearest captured motions.

    The pair is projected in order onto each sequence; what it meets is extended to the whole of that motion, from where
    it sets in to where it ends, if asked for. The timings of the nearest motions, in pose and in length,
    are averaged, nearer ones weighing more.

    Args:
        captured: features of each captured sequence, (n,P,C) each, see :func:`captured_sequences`.
        nearest: how many captured motions are averaged; the paper takes one.

    Returns:
        (frames,), 0 first and 1 last, never falling.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 6.2. Changed: several motions are
    averaged, extending is the default, and a captured motion is read along the straight way between its ends.
    """
    checked_count("nearest", nearest, 1)
    scale = region.clamp(min=0).sqrt().double()[:, None]
    pair = (keyframes.double() * scale).flatten(1)
    size = float((pair[1] - pair[0]).norm().clamp(min=1e-12))
    motions: list[Tensor] = []
    errors: list[float] = []
    for sequence in captured:
        path = (sequence.double() * scale).flatten(1)
        times, error = _on_one_motion(pair, path)
        motion = _extended(path, times, pair[1] - pair[0]) if extend else _between(path, times)
        # Both poses may lie at one of the sequence's, or at the neutrals at its ends: it has no way between them.
        leaves = (motion - motion[0]).norm(dim=1)
        if float(leaves[-1]) <= max(_ONE_WAY * float(leaves.max()), _LITTLE * size):
            continue
        missed = (pair[1] - pair[0] - (motion[-1] - motion[0])).norm()
        # Quick motions have another course than slow ones.
        errors.append((error + float(missed)) / size + abs(math.log((len(motion) - 1) / length)))
        motions.append(motion)
    if not motions:
        return torch.linspace(0, 1, frames, dtype=keyframes.dtype)
    order = torch.tensor(errors, dtype=torch.float64).sort(stable=True)
    chosen = order.indices[:nearest].tolist()
    shares = 1 / (order.values[:nearest] + 0.1 * order.values[0] + 1e-6)
    curves = torch.stack([motion_progress(motions[index], frames) for index in chosen])
    times = ((shares / shares.sum()) @ curves).clamp(0, 1).to(keyframes.dtype)
    times[-1] = 1
    return times


def captured_sequences(database: Tensor, sequences: Tensor) -> list[Tensor]:
    """The captured sequences (n,P,C) of two frames or more, of features (K,P,C) and each frame's number (K,)."""
    captured = [database[sequences == number] for number in sequences.unique()]
    captured = [sequence for sequence in captured if len(sequence) > 1]
    if not captured:
        raise ValueRangeError(
            "sequences: found none of two frames or more, expected captured motions to take timing from"
        )
    return captured


def check_keyframes(keyframes: Tensor, shape: tuple[int, ...]) -> None:
    """Refuses what is no pair of features of this shape with a motion between them."""
    if keyframes.ndim != 3 or len(keyframes) != 2 or keyframes.shape[1:] != shape:
        raise ShapeError(f"keyframes: found features {tuple(keyframes.shape)}, expected (2,*) of {tuple(shape)}")
    if not float((keyframes[1] - keyframes[0]).abs().max()) > 1e-7:
        raise ValueRangeError("keyframes: found two that are equal, expected a motion between them")


def moving_regions(keyframes: Tensor, weights: Tensor) -> Tensor:
    """Which regions, of weights (R,P), move between two keyframes, features (2,P,C): (R,) bool."""
    motion = (keyframes[1] - keyframes[0]).square().sum(-1).to(weights)
    return weights @ motion > _STILL**2 * motion.sum() * weights.mean(1)


def motion_progress(motion: Tensor, frames: int) -> Tensor:
    """How far a captured motion, features (n,D), has come from first to last pose, (frames,), never falling.

    Its frames are projected onto the straight way between both poses and put in order by isotonic regression: no step
    is larger than the captured one. Blends on that way, projected onto the frames, would share frames and jump there.
    """
    way = motion[-1] - motion[0]
    along = isotonic_regression(((motion - motion[0]) @ way).numpy()).x
    # What goes back before its start or beyond its end: whole once more, without a jump.
    course = (along - along[0]) / (along[-1] - along[0])
    progress = np.interp(np.linspace(0, len(motion) - 1, frames), np.arange(len(motion)), course)
    return torch.from_numpy(progress)


def _on_one_motion(pair: Tensor, captured: Tensor) -> tuple[Tensor, float]:
    """Where two poses (2,D) lie in order on a sequence (n,D), (2,), with little else between; how far off they are.

    The neutral stands at both ends of a sequence, and an expression is met on the way there and on the way back: by
    distance alone all four pairings are as good. Of a hold only the frame next to the motion counts.
    """
    shares, distances = segment_projections(pair, captured)
    steps = (captured[1:] - captured[:-1]).norm(dim=1)
    moments = torch.arange(len(steps)) + shares
    travelled = torch.cat([steps.new_zeros(1), steps.cumsum(0)])[:-1] + shares * steps
    way = travelled[1] - travelled[0][:, None]
    size = (pair[1] - pair[0]).norm()
    waited = _WAIT * size * (moments[1] - moments[0][:, None])
    cost = distances[0][:, None] + distances[1] + _DETOUR * (way - size).clamp(min=0) + waited
    first, last = divmod(int(torch.where(way >= 0, cost, torch.inf).argmin()), len(steps))
    # Frames that are equal have one place on the way, and the later pose may meet the earlier of them.
    times = torch.stack([moments[0, first], moments[1, last].clamp(min=moments[0, first])])
    return times, float(distances[0, first] + distances[1, last])


def _between(captured: Tensor, times: Tensor) -> Tensor:
    """The frames of a sequence (n,D) from one moment to a later one, as many as the sequence has there, at even steps.

    A sequence's own frames between these would lie at uneven steps from both ends.
    """
    first, last = times.tolist()
    moments = torch.linspace(first, last, max(math.ceil(last - first) + 1, 2), dtype=captured.dtype)
    before = moments.long().clamp(max=len(captured) - 2)
    motion = torch.lerp(captured[before], captured[before + 1], (moments - before)[:, None])
    return motion if last > first else motion[:1]


def _extended(captured: Tensor, times: Tensor, direction: Tensor) -> Tensor:
    """The frames of the whole motion along a direction (D,) in which the times of two projected poses lie."""
    along = captured @ direction
    first, last = int(times[0].floor()), min(int(times[1].ceil()), len(captured) - 1)
    extent = float(along.max() - along.min())
    start = first - _turning(along[: first + 1].flip(0), extent)
    end = last + _turning(-along[last:], extent)
    return captured[start : end + 1]


def _turning(values: Tensor, extent: float) -> int:
    """The first index of (n,) at which they are as good as least, before they have risen from there again."""
    least = values.cummin(0).values
    risen = (values - least > _DRIFT * extent).nonzero()[:, 0]
    end = int(risen[0]) if len(risen) else len(values) - 1
    return int((values <= least[end] + _HOLD * extent).nonzero()[0, 0])


def segment_projections(alpha: Tensor, beta: Tensor) -> tuple[Tensor, Tensor]:
    """Where on each segment of beta (n,D) each frame of alpha (m,D) lies nearest, 0 to 1, and how far, (m,n-1) each."""
    # By products of matrices, which take no memory in m n D; from beta's middle, which keeps their digits.
    middle = beta.mean(0)
    alpha, beta = alpha - middle, beta - middle
    step = beta[1:] - beta[:-1]
    length = step.square().sum(1)
    along = alpha @ step.T - (beta[:-1] * step).sum(1)
    shares = torch.where(length > 0, along / length.clamp(min=1e-300), torch.zeros_like(along)).clamp(0, 1)
    offset = alpha.square().sum(1)[:, None] - 2 * alpha @ beta[:-1].T + beta[:-1].square().sum(1)
    squared = offset - 2 * shares * along + shares.square() * length
    return shares, squared.clamp(min=0).sqrt()
