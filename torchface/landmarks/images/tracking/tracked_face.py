"""One face in one frame: its landmarks, and how a finder is asked for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from torchface.landmarks.images.appearance.appearance_model import AppearanceModel
from torchface.landmarks.images.appearance.appearance_refinement import appearance_landmarks
from torchface.landmarks.images.boxes.face_box import grey_pixels, overlaps
from torchface.landmarks.images.face_place import upright_box
from torchface.landmarks.images.ibug_68 import box_around, tilt_around
from torchface.landmarks.images.landmark_finder import COUNT, FoundLandmarks, LandmarkFinder, find_in_box


@dataclass(frozen=True, eq=False)
class TrackedFace:
    """One face in one frame.

    Args:
        landmarks: iBUG's 68, (68,2) float32 pixels; NaN where the face is lost.
        box: x, y, width, height round it as a detector draws it, (4,) pixels; NaN where it is lost.
        confidence: (68,) in [0,1]; one half where a landmark may be off by 0.02 of the box's side, 0 where the face is
            lost.
        visibility: (68,) in [0,1]: how likely nothing stands before the landmark; 1 where the finder does not say, 0
            where the face is lost.
        presence: in [0,1]: how likely it is a face; 0 where it is lost.

    Example:
        >>> lost = TrackedFace.lost()
        >>> lost.found, lost.confidence.max().item()
        (False, 0.0)
    """

    landmarks: Tensor
    box: Tensor
    confidence: Tensor
    visibility: Tensor = field(default_factory=lambda: torch.ones(COUNT))
    presence: float = 1.0

    @property
    def found(self) -> bool:
        """Whether there is a face."""
        return bool(torch.isfinite(self.landmarks).all())

    @classmethod
    def lost(cls) -> TrackedFace:
        """No face."""
        nothing = torch.zeros(COUNT)
        return cls(torch.full((COUNT, 2), torch.nan), torch.full((4,), torch.nan), nothing, nothing, 0.0)


class SeenFace(NamedTuple):
    """What was found, and the box (4,) that it was looked for in."""

    found: FoundLandmarks
    box: Tensor


def settled_face(finder: LandmarkFinder, image: Tensor, box: Tensor, tilt: float) -> SeenFace:
    """Landmarks from a detector's box, then from the box round what was found: detectors' boxes fit loosely.

    Once, not until it stands still: where a finder errs, it errs more from a box that follows it.
    """
    first = find_in_box(finder, image, box, tilt)
    again = upright_box(first.landmarks)
    if float(overlaps(box[None], again[None])) < 0.25 or not float(again[2]) >= 1:
        return SeenFace(first, box)
    return SeenFace(find_in_box(finder, image, again, float(tilt_around(first.landmarks))), again)


def refined_face(found: FoundLandmarks, image: Tensor, appearance: AppearanceModel | None) -> TrackedFace:
    """What was found, refined as the person looks."""
    landmarks = found.landmarks.float()
    if appearance is not None:
        landmarks = appearance_landmarks(appearance, torch.from_numpy(grey_pixels(image)), landmarks)
    return TrackedFace(
        landmarks, box_around(landmarks), found.confidence.float(), found.visibility.float(), found.presence
    )
