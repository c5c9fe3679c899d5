"""What finds the landmarks of a face in a box: one protocol, whoever finds them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError

COUNT = 68
"""iBUG's landmarks, that every finder gives."""

HALF_CONFIDENCE = 0.02
"""The deviation, in sides of the face's box, of a confidence of one half."""

_HIDDEN, _SEEN = 0.7, 0.95
_LIPS, _CHIN, _CONTOUR = slice(48, 68), slice(4, 13), 17
_GROUPS = (slice(17, 22), slice(22, 27), slice(27, 36), slice(36, 42), slice(42, 48), _LIPS)
"""Brows, nose, eyes, lips."""


@dataclass(frozen=True, eq=False)
class FoundLandmarks:
    """Landmarks of one face in one image.

    Args:
        landmarks: iBUG's 68, (68,2) float32 pixels of the whole image.
        confidence: (68,) in [0,1]; see :func:`confidence_of`.
        visibility: (68,) in [0,1]: how likely nothing stands before the landmark.
        presence: in [0,1]: how likely the box shows a face at all.

    Example:
        >>> from torchface import zoo
        >>> from torchface.landmarks import TreeFinder
        >>> blank = torch.full((80, 80), 128, dtype=torch.uint8)
        >>> found = TreeFinder(zoo.get_model("face_landmarks"))(blank, torch.tensor([10.0, 10.0, 60.0, 60.0]))
        >>> len(found.landmarks), found.confidence.max().item()  # sees nothing, and says so
        (68, 0.0)
    """

    landmarks: Tensor
    confidence: Tensor
    visibility: Tensor
    presence: float


class LandmarkFinder(Protocol):
    """Finds the 68 landmarks of the face in a box.

    The image is uint8, (H,W) or (3,H,W) red first; the box x, y, width, height, (4,) pixels, as
    :func:`~torchface.landmarks.images.ibug_68.box_around` draws it; the tilt of the face is in radians, clockwise as
    the image is seen.

    Example:
        >>> class Middle:
        ...     name = "middle"
        ...     def __call__(self, image, box, tilt=0.0):
        ...         return FoundLandmarks((box[:2] + box[2:] / 2).expand(68, 2), torch.ones(68), torch.ones(68), 1.0)
        >>> finder: LandmarkFinder = Middle()
        >>> finder(torch.zeros(80, 80, dtype=torch.uint8), torch.tensor([10.0, 10, 60, 60])).landmarks[0].tolist()
        [40.0, 40.0]
    """

    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FoundLandmarks: ...


def confidence_of(deviation: Tensor) -> Tensor:
    r""":math:`1 / (1 + (s/0.02)^2)` of deviations s in sides of the face's box: one half at 0.02."""
    return 1 / (1 + (deviation / HALF_CONFIDENCE).square())


def deviation_of(confidence: Tensor) -> Tensor:
    """Deviations in sides of the face's box of confidences in [0,1]: the inverse of :func:`confidence_of`."""
    return HALF_CONFIDENCE * (1 / confidence.clamp(min=1e-6) - 1).clamp(min=0).sqrt()


def trust_of(confidence: Tensor, visibility: Tensor) -> Tensor:
    """How much each landmark counts, (...,68) in [0,1]: its confidence, if it is seen and so is what it belongs to.

    A landmark behind a hand is a guess, however sure: below a visibility of 0.7 it does not count at all, above 0.95
    fully. Brows, nose, eyes and lips are each hidden as a whole where they are hidden in the mean: from a few points
    beside a hand a mouth would be invented.

    Args:
        confidence, visibility: of landmarks, (...,68) in [0,1].
    """
    parts = [visibility[..., group] for group in _GROUPS]
    whole = [part.minimum(part.mean(-1, keepdim=True)) for part in parts]
    # Who hides the mouth hides the chin: what is found of it would open the jaw.
    contour, lips = visibility[..., :_CONTOUR], parts[-1].mean(-1, keepdim=True)
    jaw = contour[..., : _CHIN.start], contour[..., _CHIN].minimum(lips), contour[..., _CHIN.stop :]
    seen = torch.cat([*jaw, *whole], dim=-1)
    return confidence * ((seen - _HIDDEN) / (_SEEN - _HIDDEN)).clamp(0, 1)


def finder_name(finder: LandmarkFinder) -> str:
    """What a finder is called in messages: its ``name``, or its class."""
    return str(getattr(finder, "name", type(finder).__name__))


def find_in_box(finder: LandmarkFinder, image: Tensor, box: Tensor, tilt: float = 0.0) -> FoundLandmarks:
    """What a finder finds, checked: it may be anybody's.

    Raises:
        ShapeError: it gave another count of landmarks, or other shapes; the message names the finder.
        ValueRangeError: it gave landmarks that are not finite, or likelihoods outside of [0,1].
    """
    found = finder(image, box, tilt)
    shapes = tuple(tuple(one.shape) for one in (found.landmarks, found.confidence, found.visibility))
    if shapes != ((COUNT, 2), (COUNT,), (COUNT,)):
        raise ShapeError(
            f"{finder_name(finder)}: found landmarks, confidence and visibility of {shapes[0]}, {shapes[1]} and "
            f"{shapes[2]}, expected ({COUNT},2), ({COUNT},) and ({COUNT},)"
        )
    if not bool(torch.isfinite(found.landmarks).all()):
        lost = int((~torch.isfinite(found.landmarks)).any(1).sum())
        raise ValueRangeError(f"{finder_name(finder)}: found {lost} landmarks that are not finite, expected none")
    for name in ("confidence", "visibility"):
        values = getattr(found, name)
        if not bool(((values >= 0) & (values <= 1)).all()):
            raise ValueRangeError(
                f"{finder_name(finder)}: found {name} from {float(values.min()):g} to {float(values.max()):g}, "
                "expected 0 to 1"
            )
    if not (math.isfinite(found.presence) and 0 <= found.presence <= 1):
        raise ValueRangeError(f"{finder_name(finder)}: found presence {found.presence:g}, expected 0 to 1")
    return found
