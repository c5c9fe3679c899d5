"""How a face looks, in a few hundred numbers: enough to tell two people of one video apart."""

from __future__ import annotations

from torch import Tensor

from torchface.landmarks.images.face_crop import crop_transform, cut_crop
from torchface.landmarks.images.ibug_68 import box_around, tilt_around

_SIZE, _MARGIN = 20, 1.1

LOOK_SIZE = 3 * _SIZE * _SIZE
"""Numbers that tell how a face looks."""


def face_signature(image: Tensor, landmarks: Tensor) -> Tensor:
    """A face's colours, upright and small, about their mean, of unit length.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        landmarks: of the face, (68,2) pixels.

    Returns:
        (1200,) float32; the product of two is their correlation.
    """
    tilt = float(tilt_around(landmarks))
    crop = cut_crop(image, crop_transform(box_around(landmarks, tilt), tilt, _SIZE, _MARGIN), _SIZE).float()
    # The mean of all colours goes, not that of each: how red a face is beside how blue tells people apart.
    flat = (crop - crop.mean()).flatten()
    return flat / flat.norm().clamp(min=1e-6)


def updated_signature(signature: Tensor | None, seen: Tensor, share: float) -> Tensor:
    """A running mean, of unit length, that takes a share of what was seen now."""
    if signature is None:
        return seen
    mixed = (1 - share) * signature + share * seen
    return mixed / mixed.norm().clamp(min=1e-6)
