"""The protocol of what finds the landmarks of a face in a box, and the check of what it gives."""

from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.ibug_68 import COUNT


class LandmarkFinder(Protocol):
    """Finds the 68 landmarks of the face in a box.

    The image is uint8, (H,W) or (3,H,W) red first; the box x, y, width, height, (4,) pixels, as
    :func:`~torchface.landmarks.images.ibug_68.box_around` draws it; the tilt of the face is in radians, clockwise as
    the image is seen.

    Example:
        >>> class Middle:
        ...     name = "middle"
        ...     def __call__(self, image, box, tilt=0.0):
        ...         sure = torch.ones(68)
        ...         return FaceReading((box[:2] + box[2:] / 2).expand(68, 2), sure, sure, sure[0])
        >>> finder: LandmarkFinder = Middle()
        >>> finder(torch.zeros(80, 80, dtype=torch.uint8), torch.tensor([10.0, 10, 60, 60])).landmarks[0].tolist()
        [40.0, 40.0]
    """

    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading: ...


def finder_name(finder: LandmarkFinder) -> str:
    """What a finder is called in messages: its ``name``, or its class."""
    return str(getattr(finder, "name", type(finder).__name__))


def find_in_box(finder: LandmarkFinder, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
    """What a finder reads in a box, checked: it may be anybody's."""
    reading, name = finder(image, box, tilt), finder_name(finder)
    shapes = tuple(tuple(one.shape) for one in (reading.landmarks, reading.deviation, reading.visibility))
    if shapes != ((COUNT, 2), (COUNT,), (COUNT,)):
        raise ShapeError(
            f"{name}: found landmarks, deviation and visibility of {shapes[0]}, {shapes[1]} and {shapes[2]}, expected "
            f"({COUNT},2), ({COUNT},) and ({COUNT},)"
        )
    if not bool(torch.isfinite(reading.landmarks).all()):
        lost = int((~torch.isfinite(reading.landmarks)).any(1).sum())
        raise ValueRangeError(f"{name}: found {lost} landmarks that are not finite, expected none")
    for part, most in (("deviation", torch.inf), ("visibility", 1.0), ("presence", 1.0)):
        values = getattr(reading, part)
        if not bool(((values >= 0) & (values <= most)).all()):
            raise ValueRangeError(
                f"{name}: found {part} from {float(values.min()):g} to {float(values.max()):g}, expected "
                + ("0 to 1" if most == 1 else "0 pixels or more")
            )
    # The next call may overwrite what it gave.
    return replace(reading, landmarks=reading.landmarks.clone(), search_box=box)
