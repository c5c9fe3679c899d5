"""The actor's timing of a whole animation: its keyframes are found, and the motions between them are timed anew."""

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from torchface.enhancement.enhancement_model import EnhancementModel
from torchface.enhancement.timing.motion_keyframes import find_keyframes, travelled, without_holds

_TOLERANCE = 0.08  # of the animation's range: how far its path may leave the straight way between two keyframes
_FEWEST = 4  # frames of a motion that has a timing


def retimed_moments(model: EnhancementModel, features: Tensor, fps: float) -> Tensor:
    """Which moment of an animation, features (T,P,9), each region shows in each frame, (R,T), never falling."""
    prepared = model.prepared
    weights = prepared.patch_weights
    moments = torch.arange(len(features), dtype=torch.float64).expand(len(weights), -1).clone()
    whole = (features.double() * weights.mean(0).sqrt()[:, None]).flatten(1)
    # Motions are of different length, and few.
    for first, last in pairwise(find_keyframes(whole, _TOLERANCE)):
        begin, end = (first + frame for frame in without_holds(whole[first : last + 1], fps))
        pair = features[[begin, end]]
        if end - begin + 1 < _FEWEST or torch.equal(pair[0], pair[1]):
            continue
        length = (end - begin) * model.fps / fps
        times = prepared.timing.times(pair, end - begin + 1, length)
        moments[:, begin : end + 1] = begin + _inverse(travelled(whole[begin : end + 1]), times.double())
    return moments


def at_moments(frames: Tensor, moments: Tensor, vertex_weights: Tensor) -> Tensor:
    """An animation (T,V,3) whose regions stand at moments (R,T), frames, of their own; their shares (R,V) sum to 1."""
    # From the first region's on, so that where all agree no rounding of the shares' sum moves the moment.
    base = moments[0]
    spread = (moments - base).T @ vertex_weights.to(moments)
    moment = (base[:, None] + spread).clamp(0, len(frames) - 1)
    before = moment.floor().long()
    after = (before + 1).clamp(max=len(frames) - 1)
    vertices = torch.arange(frames.shape[1])
    share = (moment - before).to(frames)[..., None]
    return torch.lerp(frames[before, vertices], frames[after, vertices], share)


def _inverse(travelled: Tensor, asked: Tensor) -> Tensor:
    """When (n,) values that rise from 0 to 1 reach what is asked, (R,m), in steps from 0 to n-1."""
    steps = torch.arange(len(travelled), dtype=torch.float64)
    # Where nothing moves, the least of slopes keeps moments apart.
    rising = (travelled + 1e-9 * steps) / (1 + 1e-9 * steps[-1])
    moments = torch.from_numpy(np.interp(asked.numpy(), rising.numpy(), steps.numpy()))
    moments[:, 0], moments[:, -1] = 0, steps[-1]
    return moments
