"""A finder of landmarks whose lids a second network sees from near."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.landmark_finder import (
    FoundLandmarks,
    LandmarkFinder,
    confidence_of,
    deviation_of,
    finder_name,
)
from torchface.landmarks.images.networks.eye_finder import EyeFinder, face_without_eyes


@dataclass(frozen=True, eq=False)
class EyedFinder:
    """Finds landmarks, then looks at the eyes among them.

    Args:
        finder: finds all 68.
        eyes: refines those of the lids.
    """

    finder: LandmarkFinder
    eyes: EyeFinder

    @property
    def name(self) -> str:
        """What messages call it."""
        return finder_name(self.finder)

    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FoundLandmarks:
        """See :class:`~torchface.landmarks.images.landmark_finder.LandmarkFinder`."""
        found, side = self.finder(image, box, tilt), _side(box)
        face = self._looked_at(image, found, side)
        return replace(found, landmarks=face.landmarks, confidence=confidence_of(face.deviation / side))

    def read(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        """The face in a box with its eyes.

        Args:
            image, box, tilt: see :class:`~torchface.landmarks.images.landmark_finder.LandmarkFinder`.
        """
        return self._looked_at(image, self.finder(image, box, tilt), _side(box))

    def _looked_at(self, image: Tensor, found: FoundLandmarks, side: float) -> FaceReading:
        deviation = side * deviation_of(found.confidence)
        presence = torch.tensor(found.presence)
        return self.eyes(image, face_without_eyes(found.landmarks, deviation, found.visibility, presence))


def _side(box: Tensor) -> float:
    return float((box[2] * box[3]).clamp(min=0).sqrt())
