"""Place of a face in a picture: middle, side and roll angle of the square round it.

A place is (5,): x and y of the middle, side, cosine and sine of the roll angle, clockwise as the picture is seen.
"""

import torch
from torch import Tensor

from torchface.landmarks.images.ibug_68 import turned_box


def axes(place: Tensor) -> Tensor:
    """The upright face's axes in the picture, rows of (2,2)."""
    cos, sin = place[3], place[4]
    return torch.stack([cos, sin, -sin, cos]).view(2, 2)


def place_around(landmarks: Tensor) -> Tensor:
    """The place of a face with landmarks (68,2): :func:`~torchface.landmarks.images.ibug_68.turned_box`."""
    box, angle = turned_box(landmarks)
    return torch.cat([box[:2] + box[2:] / 2, box[2:3], angle.cos()[None], angle.sin()[None]])


def sought(place: Tensor, anchor: Tensor) -> Tensor:
    """Where a face is looked for whose place and whose relation (3,) to where it was found are known."""
    middle = place[:2] + place[2] * (anchor[:2] @ axes(place))
    return torch.cat([middle, place[2:3] * anchor[2], place[3:]])


def relation(place: Tensor, looked: Tensor) -> Tensor:
    """Where a face was looked for, as its own place sees it: the middle in sides of that, and the size; (3,)."""
    offset = axes(place) @ (looked[:2] - place[:2]) / place[2]
    return torch.cat([offset.clamp(-0.3, 0.3), (looked[2:3] / place[2]).clamp(0.7, 1.4)])


def overlap(middles: Tensor, sides: Tensor, place: Tensor) -> Tensor:
    """The shared share (...) of squares with middles (...,2) and sides (...) and that of a place, not turned."""
    reach = sides[..., None] / 2
    low = torch.maximum(middles - reach, place[:2] - place[2] / 2)
    high = torch.minimum(middles + reach, place[:2] + place[2] / 2)
    shared = (high - low).clamp(min=0).prod(-1)
    return shared / (sides.square() + place[2].square() - shared).clamp(min=1e-6)


def plausible(place: Tensor, size: Tensor, smallest: float) -> Tensor:
    """Whether a face can have this place in a picture of a size (2,), width and height; () bool."""
    inside = ((place[:2] >= 0) & (place[:2] < size)).all()
    return inside & (place[2] >= smallest) & (place[2] <= 1.5 * size.amax(0))
