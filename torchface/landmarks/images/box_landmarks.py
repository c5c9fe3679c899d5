"""Landmarks of a face from a detector's box: of a photograph, and of what a tracker looks for."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.landmarks.images.appearance.appearance_model import AppearanceModel
from torchface.landmarks.images.boxes.face_box import FaceDetector, NoFaceError, grey_pixels, overlaps
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.find_faces import find_some_faces
from torchface.landmarks.images.ibug_68 import box_around, turned_box
from torchface.landmarks.images.landmark_finder import LandmarkFinder, find_in_box
from torchface.landmarks.images.trees.landmark_trees import LandmarkTrees
from torchface.landmarks.images.trees.tree_finder import PHOTOGRAPH, TreeFinder


def settled_face(finder: LandmarkFinder, image: Tensor, box: Tensor, tilt: float) -> FaceReading:
    """Landmarks from a detector's box (4,), then from the box round what was found: detectors' boxes fit loosely.

    Once, not until it stands still: where a finder errs, it errs more from a box that follows it.
    """
    first = find_in_box(finder, image, box, tilt)
    again, turn = turned_box(first.landmarks)
    if float(overlaps(box[None], again[None])) < 0.25 or not float(again[2]) >= 1:
        return first
    return find_in_box(finder, image, again, float(turn))


def refined_face(face: FaceReading, image: Tensor, appearance: AppearanceModel | None) -> FaceReading:
    """A face whose landmarks are refined by the person's appearance in an image (C,H,W)."""
    if appearance is None:
        return face
    return replace(
        face, landmarks=appearance_landmarks(appearance, torch.from_numpy(grey_pixels(image)), face.landmarks)
    )


@torch.no_grad()
def appearance_landmarks(appearance: AppearanceModel, grey: Tensor, start: Tensor) -> Tensor:
    """Landmarks (68,2), pixels, where the face looks more as the person does; the start where it does not."""
    box = box_around(start)
    height, width = grey.shape
    low = (box[:2] - box[2:] / 2).clamp(min=0).long()
    high = (box[:2] + 1.5 * box[2:]).ceil().long()
    piece = grey[int(low[1]) : min(int(high[1]) + 1, height), int(low[0]) : min(int(high[0]) + 1, width)]
    if 0 in piece.shape:
        return start
    fit = appearance.refine(piece[None, None].float() / 255, (start - low)[None])
    better = bool(torch.isfinite(fit.landmarks).all()) and float(fit.error) <= float(fit.initial_error)
    near = float((fit.landmarks[0] + low - start).norm(dim=1).mean()) < 0.15 * float(box[2]) if better else False
    return (fit.landmarks[0] + low).to(start) if near else start


# Presence under which a photograph shows no face: boxes in pictures without one had 0.27 to 0.57.
_PHOTOGRAPHED = 0.6
_TRIED = 5  # boxes, where no face was asked for by number


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
        detector: finds boxes; see :func:`find_faces`.
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
    faces = find_some_faces(image, face, detector)
    refused: list[FaceReading] = []
    for number in range(len(faces))[:_TRIED] if face == 0 else [face]:  # the largest box may show none
        reading = settled_face(finder, image, faces.boxes[number], float(faces.tilts[number]))
        if float(reading.presence) >= _PHOTOGRAPHED:
            return refined_face(reading, image, appearance)
        refused.append(reading)
    x, y, wide = (round(float(value)) for value in refused[0].search_box[:3])
    raise NoFaceError(
        f"image of {image.shape[-1]} x {image.shape[-2]}: found something at ({x}, {y}), {wide} pixels wide, that "
        f"is a face with a probability of {float(refused[0].presence):.2f}, expected a face"
    )
