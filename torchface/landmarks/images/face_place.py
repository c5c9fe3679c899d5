"""Where a face lies in an image: its upright box and its tilt, and another box as the face sees it."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.landmarks.images.ibug_68 import box_around, tilt_around


def face_place(landmarks: Tensor) -> Tensor:
    """Where a face is: its upright box and its tilt, (5,)."""
    return torch.cat([upright_box(landmarks), tilt_around(landmarks)[None]])


def upright_box(landmarks: Tensor) -> Tensor:
    """The box (4,) round landmarks (68,2) as if the face were turned upright."""
    return box_around(landmarks, float(tilt_around(landmarks)))


def box_relation(box: Tensor, other: Tensor, tilt: Tensor) -> Tensor:
    """Where another box (4,) lies, as a face with this tilt sees it: its middle from the box's (2,) in sides of that,
    and its size by that's; (3,)."""
    offset = (other[:2] + other[2:] / 2 - box[:2] - box[2:] / 2) / box[2]
    return torch.cat([(upright_turn(tilt).T @ offset).clamp(-0.3, 0.3), (other[2:3] / box[2:3]).clamp(0.7, 1.4)])


def upright_turn(tilt: Tensor) -> Tensor:
    """The rotation (2,2) of a face with a tilt, clockwise as the image is seen."""
    cos, sin = tilt.cos(), tilt.sin()
    return torch.stack([cos, -sin, sin, cos]).view(2, 2)
