"""Faces of any roll angle, by a detector of upright ones: on small copies of the image, each turned."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import torch
from torch import Tensor

from torchface.landmarks.images.boxes.face_box import (
    FaceBoxes,
    FaceDetector,
    HaarDetector,
    find_faces,
    grey_pixels,
    overlaps,
    sorted_boxes,
)
from torchface.landmarks.images.boxes.network_detector import shipped_detector

_LONGEST = 480
_ANGLES = (40.0, -40.0, 90.0, -90.0, 180.0)
_SAME = 0.3
_CLEAR = 0.5  # least score: five turns show five times as much that is no face, and what is one scored 0.69 to 0.85


def find_faces_of_any_turn(image: Tensor, detector: FaceDetector | None = None) -> FaceBoxes:
    """All faces in an image, the largest first; where none is upright those that are turned.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        detector: finds upright faces; the shipped cascades if absent.
    """
    faces = find_faces(image, detector)
    return faces if len(faces) else find_turned_faces(image, detector or HaarDetector())


def find_turned_faces(image: Tensor, detector: FaceDetector) -> FaceBoxes:
    """Faces turned by about 40, 90 or 180 degrees, the largest first, with their tilts.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        detector: finds upright faces; one that tells tilts is believed on top of the turn. Before the cascades, which
            know upright faces alone, the shipped network of face boxes is asked.
    """
    if isinstance(detector, HaarDetector):
        faces = find_in_quarter_turns(image, shipped_detector())
        if len(faces):
            return faces
    return _find_in_turns(image, detector)


def find_in_quarter_turns(image: Tensor, detector: FaceDetector) -> FaceBoxes:
    """Faces at every roll angle, the largest first, by a detector that tells tilts but knows upright faces best.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        detector: is shown the image upright, on either side, and upside down.
    """
    height, width = image.shape[-2:]
    boxes, scores, tilts = [], [], []
    for quarters in range(4):  # counter-clockwise; a detector is shown one image at a time
        found = find_faces(image.rot90(quarters, (-2, -1)), detector)
        sides = found.boxes[:, 2:]
        x, y = (found.boxes[:, :2] + sides / 2).unbind(1)
        back = ((x, y), (width - 1 - y, x), (width - 1 - x, height - 1 - y), (y, height - 1 - x))[quarters]
        boxes.append(torch.cat([torch.stack(back, 1) - sides / 2, sides], 1))
        scores.append(found.scores)
        tilts.append(found.tilts + quarters * math.pi / 2)
    return _best(torch.cat(boxes), torch.cat(scores), torch.cat(tilts))


def _find_in_turns(image: Tensor, detector: FaceDetector) -> FaceBoxes:
    """Faces turned by about 40, 90 or 180 degrees, by a detector of upright ones."""
    grey = grey_pixels(image)
    scale = min(1.0, _LONGEST / max(grey.shape))
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale < 1 else grey
    if isinstance(detector, HaarDetector):
        detector = replace(detector, profiles="never")
    ratio = torch.tensor([grey.shape[1] / size[0], grey.shape[0] / size[1]])
    boxes, scores, tilts = [torch.zeros(0, 4)], [torch.zeros(0)], [torch.zeros(0)]
    for degrees in _ANGLES:  # a detector is shown one image at a time
        angle = math.radians(degrees)
        cos, sin = math.cos(angle), math.sin(angle)
        width, height = (
            math.ceil(abs(cos) * size[0] + abs(sin) * size[1]),
            math.ceil(abs(sin) * size[0] + abs(cos) * size[1]),
        )
        turn = torch.tensor([[cos, sin], [-sin, cos]], dtype=torch.float64)  # of the picture, against the face's tilt
        middle = torch.tensor([(size[0] - 1) / 2, (size[1] - 1) / 2], dtype=torch.float64)
        shift = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64) - turn @ middle
        way = torch.cat([turn, shift[:, None]], 1).numpy()
        turned = cv2.warpAffine(small, way, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        found = find_faces(torch.from_numpy(turned), detector)
        clear = found.scores >= _CLEAR
        found = FaceBoxes(found.boxes[clear], found.scores[clear], found.tilts[clear])
        if not len(found):
            continue
        at = (found.boxes[:, :2] + found.boxes[:, 2:] / 2).double()
        back = (((at - shift) @ turn).float() + 0.5) * ratio - 0.5
        sides = found.boxes[:, 2:] * ratio.mean()
        boxes.append(torch.cat([back - sides / 2, sides], 1))
        scores.append(found.scores)
        tilts.append(found.tilts + angle)
    return _best(torch.cat(boxes), torch.cat(scores), torch.cat(tilts))


def _best(boxes: Tensor, scores: Tensor, tilts: Tensor) -> FaceBoxes:
    """One face where several turns show the same: that of the highest score."""
    kept: list[int] = []
    for i in scores.argsort(descending=True, stable=True).tolist():  # a few faces
        if not kept or float(overlaps(boxes[i : i + 1], boxes[kept]).max()) < _SAME:
            kept.append(i)
    return sorted_boxes(boxes[kept], scores[kept], tilts[kept])
