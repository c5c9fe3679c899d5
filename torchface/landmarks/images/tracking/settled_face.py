"""Landmarks from a detector's loose box, and refined by how the person looks."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchface.landmarks.images.appearance.appearance_model import AppearanceModel
from torchface.landmarks.images.boxes.face_box import grey_pixels, overlaps
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.ibug_68 import box_around, turned_box
from torchface.landmarks.images.landmark_finder import LandmarkFinder, find_in_box


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
    """A face whose landmarks are refined as the person looks."""
    if appearance is None:
        return face
    return replace(
        face, landmarks=appearance_landmarks(appearance, torch.from_numpy(grey_pixels(image)), face.landmarks)
    )


@torch.no_grad()
def appearance_landmarks(appearance: AppearanceModel, grey: Tensor, start: Tensor) -> Tensor:
    """Landmarks (68,2) where the face looks more as the person does; the start (68,2) where it does not.

    Args:
        appearance: of the person.
        grey: the image, uint8 (H,W).
        start: (68,2), pixels.
    """
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
