"""iBUG's 68 landmarks: which are mirror images of each other, and the face boxes and tilts that go with them."""

import torch
from torch import Tensor

from torchface.errors import ShapeError

COUNT = 68

_RUNS = ((0, 16), (17, 26), (27, 27), (28, 28), (29, 29), (30, 30), (31, 35))
_PAIRS = ((36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46))
_LIPS = ((48, 54), (55, 59), (60, 64), (65, 67))
_RIGHT_EYE, _LEFT_EYE, _MOUTH = slice(36, 42), slice(42, 48), slice(48, 68)
SIDE_OF_EXTENT = 1.6  # a box's side, of the extent of brows, nose, eyes and mouth
MIDDLE_ABOVE = 0.037  # how far the box's middle lies above their mean, in sides of the box


def _mirror() -> tuple[int, ...]:
    twins = {row: first + last - row for first, last in _RUNS + _LIPS for row in range(first, last + 1)}
    twins |= dict(_PAIRS) | {right: left for left, right in _PAIRS}
    return tuple(twins[row] for row in range(COUNT))


MIRROR_68 = _mirror()  # which of the 68 each becomes when the image is mirrored
INNER = slice(17, 68)  # brows, nose, eyes and mouth: all but the jaw's contour


# Landmarks, and by which share of the way to another annotators put them further (away from it, if negative).
_RIGHT = ((36, 39, 0.11), (37, 38, 0.41), (38, 39, 0.22), (40, 39, 0.10), (41, 40, 0.31), (31, 32, -0.2),
          (49, 50, 0.15), (58, 57, 0.3), (60, 64, 0.09), (61, 62, 0.35), (67, 66, 0.35))  # fmt: skip
_MIDDLE = ((28, 29, 0.2), (29, 30, 0.2), (33, 51, 0.13))
_ALONG = _MIDDLE + _RIGHT + tuple((MIRROR_68[row], MIRROR_68[toward], share) for row, toward, share in _RIGHT)


def as_annotated(landmarks: Tensor) -> Tensor:
    """Landmarks (...,68,C) of heads moved along lids and nostrils to where annotators, and what learns from them, put
    them.

    Of 23 faces with iBUG's landmarks: eyes end at their outer side a tenth of their width before the corner that heads
    are annotated with, the lids' points lie at 0.30 and 0.68 of that (heads have theirs at 0.21 and 0.63 above, 0.24
    below), the nostrils' outer ones further out, the inner lips' nearer to the middle.
    """
    moved = landmarks.clone()
    for row, toward, share in _ALONG:
        moved[..., row, :] = landmarks[..., row, :] + share * (landmarks[..., toward, :] - landmarks[..., row, :])
    return moved


def tilt_around(landmarks: Tensor) -> Tensor:
    """How far a face is turned in the image plane, (...,) radians, clockwise as seen, by where eyes and mouth lie to
    each other; NaN where landmarks are missing."""
    if landmarks.shape[-2:] != (68, 2):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (...,68,2)")
    right, left, mouth = (landmarks[..., rows, :].mean(-2) for rows in (_RIGHT_EYE, _LEFT_EYE, _MOUTH))
    across, down = left - right, mouth - (left + right) / 2
    # Both axes of the face, the second turned on the first: a head that turns aside shortens the first alone.
    return torch.atan2(across[..., 1] - down[..., 0], across[..., 0] + down[..., 1])


def box_around(landmarks: Tensor) -> Tensor:
    r"""The box that a face detector of OpenCV's kind would draw round landmarks.

    A square of :math:`1.6\sqrt{(w^2 + h^2)/2}`, w and h the extent of brows, nose, eyes and mouth; their mean lies in
    its middle, a little below. The two factors are medians of the boxes of OpenCV's Haar cascade over frontal faces.

    Returns:
        x, y, width, height, (...,4) pixels; NaN where brows, nose, eyes and mouth are all missing.
    """
    if landmarks.shape[-2:] != (68, 2):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (...,68,2)")
    inner = landmarks[..., INNER, :]
    seen = torch.isfinite(inner).all(-1, keepdim=True)
    low = torch.where(seen, inner, torch.inf).amin(-2)
    high = torch.where(seen, inner, -torch.inf).amax(-2)
    middle = torch.where(seen, inner, 0).sum(-2) / seen.sum(-2)
    side = SIDE_OF_EXTENT * ((high - low).square().sum(-1, keepdim=True) / 2).sqrt()
    centre = middle + side * middle.new_tensor([0.0, -MIDDLE_ABOVE])
    box = torch.cat([centre - side / 2, side, side], dim=-1)
    return torch.where(torch.isfinite(box).all(-1, keepdim=True), box, torch.nan)


def turned_box(landmarks: Tensor, tilt: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The box of :func:`box_around` with each face's tilt, and these tilts.

    Args:
        landmarks: iBUG's 68, (...,68,2), pixels.
        tilt: (...,) radians; :func:`tilt_around` the landmarks if absent.

    Returns:
        x, y, width, height of squares whose middle and side are those of the box in the face's own frame, (...,4); and
        the tilts, (...).
    """
    angle = tilt_around(landmarks) if tilt is None else tilt
    across = torch.stack([angle.cos(), angle.sin()], dim=-1)
    frame = torch.stack([across, torch.stack([-across[..., 1], across[..., 0]], dim=-1)], dim=-1)  # (...,2,2), columns
    upright = box_around(landmarks @ frame)
    middle = (frame @ (upright[..., :2] + upright[..., 2:] / 2)[..., None])[..., 0]
    return torch.cat([middle - upright[..., 2:] / 2, upright[..., 2:]], dim=-1), angle


def relative_errors(found: Tensor, truth: Tensor) -> Tensor:
    """The mean distance (B,) of landmarks (B,68,2) from the truth, over that of the outer corners of the eyes.

    Landmarks of NaN are left out.
    """
    if found.shape != truth.shape or truth.ndim != 3 or truth.shape[1:] != (68, 2):
        raise ShapeError(f"landmarks: found {tuple(found.shape)} and {tuple(truth.shape)}, expected (B,68,2) twice")
    return (found - truth).norm(dim=-1).nanmean(1) / (truth[:, 36] - truth[:, 45]).norm(dim=-1)
