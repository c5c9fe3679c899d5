"""Which frames of a video show all that a face does, so that a few annotated ones are enough to learn from."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.appearance.shape_modes import procrustes_mean

_PARTS = (slice(0, 17), slice(17, 22), slice(22, 27), slice(27, 36), slice(36, 42), slice(42, 48), slice(48, 68))
_ASTRAY = 6.0
_MIN_DEVIATION = 0.01


def choose_frames(landmarks: Tensor, count: int = 15, confidence: Tensor | None = None) -> Tensor:
    r"""Frames that lie far apart: the face as it mostly is, then again and again the one least like those chosen.

    Shapes are compared without their poses, part by part (jaw, brows, nose, eyes, mouth), each part in units of how
    much it moves in this video, so that a wide mouth does not outvote a brow:

    .. math:: d(a, b)^2 = \sum_p \frac{|a_p - b_p|^2}{s_p^2}

    Farthest points come first where a tracker lost the face too; frames whose shape is none (six times as far from the
    usual one as is usual) are left out.

    Args:
        landmarks: the 68 as tracked, (T,68,2) pixels; NaN where lost.
        count: how many; fewer come back where fewer frames differ.
        confidence: of the tracker, (T,68) in [0,1]: the fifth of the frames with the lowest is left out.

    Returns:
        Frame numbers in the order of choice, the neutral one first, int64.

    Raises:
        ShapeError: not (T,68,2).
        ValueRangeError: fewer than one frame asked for, or the face was never found.
    """
    if landmarks.ndim != 3 or landmarks.shape[1:] != (68, 2):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (T,68,2)")
    if count < 1:
        raise ValueRangeError(f"count: found {count}, expected at least 1")
    usable = torch.isfinite(landmarks).flatten(1).all(1)
    if confidence is not None and usable.any():
        sure = torch.nan_to_num(confidence.mean(1))
        usable = usable & (sure >= sure[usable].quantile(0.2))
    frames = torch.nonzero(usable)[:, 0]
    if len(frames) == 0:
        raise ValueRangeError(f"landmarks: found a face in none of {len(landmarks)} frames, expected some")
    _, aligned = procrustes_mean(landmarks[frames].double())
    distance = (aligned - aligned.median(0).values).flatten(1).norm(dim=1)
    sound = distance <= _ASTRAY * distance.median() + 1e-9
    frames, aligned = frames[sound], aligned[sound]
    offset = aligned - aligned.median(0).values
    spread = torch.stack([offset[:, part].square().sum((1, 2)).mean().sqrt() for part in _PARTS])
    weights = 1 / spread.clamp(min=_MIN_DEVIATION)
    scaled = torch.cat([w * offset[:, part].flatten(1) for w, part in zip(weights, _PARTS, strict=True)], dim=1)
    chosen = [int(scaled.norm(dim=1).argmin())]
    nearest = (scaled - scaled[chosen[0]]).norm(dim=1)
    while len(chosen) < min(count, len(frames)) and float(nearest.max()) > 0:
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (scaled - scaled[chosen[-1]]).norm(dim=1))
    return frames[chosen]
