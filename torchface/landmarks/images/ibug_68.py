"""iBUG's 68 landmarks: which are mirror images of each other, and the face box that goes with them."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import ShapeError

_RUNS = ((0, 16), (17, 26), (27, 27), (28, 28), (29, 29), (30, 30), (31, 35))
_PAIRS = ((36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46))
_LIPS = ((48, 54), (55, 59), (60, 64), (65, 67))
_SIDE = 1.6
_ABOVE, _ASIDE = 0.037, 0.0


def _mirror() -> tuple[int, ...]:
    twins = {row: first + last - row for first, last in _RUNS + _LIPS for row in range(first, last + 1)}
    twins |= dict(_PAIRS) | {right: left for left, right in _PAIRS}
    return tuple(twins[row] for row in range(68))


MIRROR_68 = _mirror()
"""Which of the 68 each becomes when the image is mirrored."""

INNER = slice(17, 68)
"""Brows, nose, eyes and mouth: all but the jaw's contour."""


def box_around(landmarks: Tensor) -> Tensor:
    r"""The box that a face detector of OpenCV's kind would draw round landmarks.

    A square of :math:`1.6\sqrt{(w^2 + h^2)/2}`, w and h the extent of brows, nose, eyes and mouth; their mean lies in
    its middle, a little below. The two factors are medians of the shipped Haar cascade's boxes over frontal faces.

    Args:
        landmarks: iBUG's 68, (...,68,2), pixels; NaN rows are left out.

    Returns:
        x, y, width, height, (...,4) pixels; NaN where brows, nose, eyes and mouth are all missing.

    Raises:
        ShapeError: not (...,68,2).
    """
    if landmarks.shape[-2:] != (68, 2):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (...,68,2)")
    inner = landmarks[..., INNER, :]
    seen = torch.isfinite(inner).all(-1, keepdim=True)
    low = torch.where(seen, inner, torch.inf).amin(-2)
    high = torch.where(seen, inner, -torch.inf).amax(-2)
    middle = torch.where(seen, inner, 0).sum(-2) / seen.sum(-2)
    side = _SIDE * ((high - low).square().sum(-1, keepdim=True) / 2).sqrt()
    corner = middle - side * middle.new_tensor([0.5 - _ASIDE, 0.5 + _ABOVE])
    box = torch.cat([corner, side, side], dim=-1)
    return torch.where(torch.isfinite(box).all(-1, keepdim=True), box, torch.nan)


def relative_errors(found: Tensor, truth: Tensor) -> Tensor:
    """The mean distance of each face's landmarks from the truth, over that of the outer corners of its eyes, (B,).

    Args:
        found, truth: iBUG's 68, (B,68,2), pixels; rows where one of them is NaN are left out.

    Raises:
        ShapeError: not (B,68,2) twice.
    """
    if found.shape != truth.shape or truth.ndim != 3 or truth.shape[1:] != (68, 2):
        raise ShapeError(f"landmarks: found {tuple(found.shape)} and {tuple(truth.shape)}, expected (B,68,2) twice")
    return (found - truth).norm(dim=-1).nanmean(1) / (truth[:, 36] - truth[:, 45]).norm(dim=-1)
