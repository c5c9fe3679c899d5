"""Landmarks of one face in a photograph."""

from __future__ import annotations

from torch import Tensor

from torchface.landmarks.images.appearance.appearance_model import AppearanceModel
from torchface.landmarks.images.boxes.face_box import FaceDetector, NoFaceError
from torchface.landmarks.images.boxes.find_faces import find_faces_of_any_turn, find_some_faces
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.landmark_finder import LandmarkFinder
from torchface.landmarks.images.tracking.settled_face import refined_face, settled_face
from torchface.landmarks.images.trees.landmark_trees import LandmarkTrees
from torchface.landmarks.images.trees.tree_finder import PHOTOGRAPH, TreeFinder

# Presence under which a photograph shows no face: boxes in pictures without one had 0.27 to 0.57.
_PHOTOGRAPHED = 0.6


def find_landmarks(
    image: Tensor,
    finder: LandmarkFinder | LandmarkTrees,
    face: int = 0,
    detector: FaceDetector | None = None,
    appearance: AppearanceModel | None = None,
) -> FaceReading:
    """Landmarks of one face in a photograph.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        finder: finds 68 landmarks in a box; landmark trees do so from 48 starts.
        face: which one, from 0, the largest first.
        detector: finds boxes; the shipped cascades if absent.
        appearance: of this person; refines what the finder finds.

    Raises:
        NoFaceError: there are not so many faces, or the finder says that the box shows none.
        ShapeError: no such image, or a finder that gives other landmarks than the 68.
        ValueRangeError: trees that find other landmarks than the 68, or a finder that gives some that are not finite.

    Example:
        >>> from torchface import zoo
        >>> blank = torch.full((120, 160), 128, dtype=torch.uint8)
        >>> find_landmarks(blank, zoo.get_model("face_landmarks"))
        Traceback (most recent call last):
            ...
        torchface.landmarks.images.boxes.face_box.NoFaceError: image of 160 x 120: found no face, expected one at least
    """
    finder = TreeFinder(finder, PHOTOGRAPH) if isinstance(finder, LandmarkTrees) else finder
    faces = find_some_faces(image, face, detector or find_faces_of_any_turn)
    reading = settled_face(finder, image, faces.boxes[face], float(faces.tilts[face]))
    presence = float(reading.presence)
    if presence < _PHOTOGRAPHED:
        x, y, wide = (round(float(value)) for value in reading.search_box[:3])
        raise NoFaceError(
            f"image of {image.shape[-1]} x {image.shape[-2]}: found something at ({x}, {y}), {wide} pixels wide, that "
            f"is a face with a probability of {presence:.2f}, expected a face"
        )
    return refined_face(reading, image, appearance)
