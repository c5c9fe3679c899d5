"""A whole animation in the actor's timing: its keyframes are found, and the motions between them are timed anew."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from torchface.enhancement.enhancement_model import EnhancementModel
from torchface.enhancement.retiming import retime_features
from torchface.errors import ShapeError

_TOLERANCE = 0.08  # of the animation's range: how far its path may leave the straight way between two keyframes
_HOLD = 0.01  # of a motion's length: what is shorter at either end is a hold


def retime_animation(model: EnhancementModel, coarse: Tensor) -> Tensor:
    """An animation with the actor's timing between its keyframes, which stay where and what they are.

    Args:
        model: of the actor.
        coarse: (T,V,3), millimetres, in the model's mesh.

    Returns:
        (T,V,3).

    Raises:
        TopologyError: another number of vertices, or another order.
    """
    moments = retimed_moments(model, model.features(coarse))
    return at_moments(coarse, moments, model.vertex_weights)


def retimed_moments(model: EnhancementModel, features: Tensor) -> Tensor:
    """Which moment of an animation each region shows in each frame, (R,T), in frames, never falling.

    Args:
        model: of the actor.
        features: of the animation's frames, (T,P,9).
    """
    weights = model.patch_weights
    moments = torch.arange(len(features), dtype=torch.float64).expand(len(weights), -1).clone()
    whole = (features.double() * weights.mean(0).sqrt()[:, None]).flatten(1)
    keys = find_keyframes(whole)
    # Motions are of different length, and few.
    for first, last in pairwise(keys):
        lengths = (whole[first + 1 : last + 1] - whole[first:last]).norm(dim=1)
        travelled = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
        if not float(travelled[-1]) > 0:
            continue
        travelled = travelled / travelled[-1]
        moving = ((travelled > _HOLD) & (travelled < 1 - _HOLD)).nonzero()[:, 0]
        if len(moving) < 2:
            continue
        begin, end = first + int(moving[0]) - 1, first + int(moving[-1]) + 1
        own = travelled[begin - first : end - first + 1]
        own = (own - own[0]) / (own[-1] - own[0])
        pair = features[[begin, end]]
        if torch.equal(pair[0], pair[1]):
            continue
        times = retime_features(pair, model.database_features, model.sequences, weights, end - begin + 1)
        moments[:, begin : end + 1] = begin + _inverse(own, times.double())
    return moments


def at_moments(frames: Tensor, moments: Tensor, vertex_weights: Tensor) -> Tensor:
    """An animation whose regions stand at moments of their own.

    Args:
        frames: (S,V,3).
        moments: in frames from the first of ``frames`` on, (R,T).
        vertex_weights: the share of each region in each vertex, (R,V), of sum 1.

    Returns:
        (T,V,3).

    Raises:
        ShapeError: the shapes do not fit.
    """
    if frames.ndim != 3 or len(moments) != len(vertex_weights) or vertex_weights.shape[1] != frames.shape[1]:
        raise ShapeError(
            f"at_moments: found frames {tuple(frames.shape)}, moments {tuple(moments.shape)} and weights "
            f"{tuple(vertex_weights.shape)}, expected (S,V,3), (R,T) and (R,V)"
        )
    # From the first region's on, so that where all agree no rounding of the shares' sum moves the moment.
    base = moments[0]
    spread = (moments - base).T @ vertex_weights.to(moments)
    place = (base[:, None] + spread).clamp(0, len(frames) - 1)
    before = place.floor().long()
    after = (before + 1).clamp(max=len(frames) - 1)
    vertices = torch.arange(frames.shape[1])
    share = (place - before).to(frames)[..., None]
    return torch.lerp(frames[before, vertices], frames[after, vertices], share)


def find_keyframes(path: Tensor) -> list[int]:
    """The frames at which a motion (T,D) turns, the first and the last among them, rising.

    The path is simplified as a line: it is cut where it leaves the straight way between two keyframes furthest, until
    it nowhere leaves it by more than a share of the animation's range.

    Source: Douglas and Peucker 1973.
    """
    if len(path) < 3:
        return list(range(len(path)))
    limit = _TOLERANCE * float((path.amax(0) - path.amin(0)).norm())
    keys, open_pieces = [0, len(path) - 1], [(0, len(path) - 1)]
    # Each cut depends on the one before.
    while open_pieces:
        first, last = open_pieces.pop()
        if last - first < 2:
            continue
        way = path[last] - path[first]
        offset = path[first + 1 : last] - path[first]
        share = (offset @ way / way.square().sum().clamp(min=1e-30)).clamp(0, 1)
        distance = (offset - share[:, None] * way).norm(dim=1)
        worst = int(distance.argmax())
        if float(distance[worst]) > limit:
            cut = first + 1 + worst
            keys.append(cut)
            open_pieces += [(first, cut), (cut, last)]
    return sorted(keys)


def _inverse(travelled: Tensor, asked: Tensor) -> Tensor:
    """When (n,) values that rise from 0 to 1 reach what is asked, (R,m), in steps from 0 to n-1."""
    steps = torch.arange(len(travelled), dtype=torch.float64)
    # Where nothing moves, the least of slopes tells moments apart.
    rising = (travelled + 1e-9 * steps) / (1 + 1e-9 * steps[-1])
    right = torch.searchsorted(rising, asked.contiguous()).clamp(1, len(rising) - 1)
    span = (rising[right] - rising[right - 1]).clamp(min=1e-15)
    found = steps[right - 1] + ((asked - rising[right - 1]) / span).clamp(0, 1)
    found[:, 0], found[:, -1] = 0, steps[-1]
    return found
