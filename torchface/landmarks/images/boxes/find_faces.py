"""Searches of an image for faces: upright ones, those at any roll angle, one by its number."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import torch
from torch import Tensor

from torchface.landmarks.images.boxes.face_box import (
    FaceBoxes,
    FaceDetector,
    NoFaceError,
    check_image,
    grey_pixels,
    one_each,
    shrunk,
    sorted_boxes,
)
from torchface.landmarks.images.boxes.haar_detector import PICTURE, TURNED, HaarDetector
from torchface.landmarks.images.boxes.network_detector import shipped_detector

_TURNED_LONGEST = 480  # pixels of the copy that cascades are shown in turns
_ANGLES = (40.0, -40.0, 90.0, -90.0, 180.0)
_CLEAR = 0.5  # least score: five turns show five times as much that is no face, and what is one scored 0.69 to 0.85


def find_faces(image: Tensor, detector: FaceDetector | None = None) -> FaceBoxes:
    """All faces in an image, the largest first; none is no error.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        detector: the shipped cascades if absent, profiles beside frontal faces.

    Raises:
        ShapeError: no such image.

    Example:
        >>> len(find_faces(torch.full((120, 160), 128, dtype=torch.uint8)).boxes)
        0
    """
    check_image(image)
    return (detector or HaarDetector(**PICTURE))(image)


def find_face(image: Tensor, number: int = 0, detector: FaceDetector | None = None) -> Tensor:
    """The box of one face: x, y, width, height, (4,) pixels; see :func:`find_some_faces`.

    Example:
        >>> from torchface.landmarks import NoFaceError
        >>> try:
        ...     box = find_face(torch.full((120, 160), 128, dtype=torch.uint8))
        ... except NoFaceError as error:
        ...     print(error)
        image of 160 x 120: found no face, expected one at least
    """
    return find_some_faces(image, number, detector).boxes[number]


def find_some_faces(image: Tensor, number: int = 0, detector: FaceDetector | None = None) -> FaceBoxes:
    """All faces in an image, the largest first, one of this number among them.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        number: of the face that must be there, from 0.
        detector: the shipped cascades if absent.
    """
    faces = find_faces(image, detector)
    if not 0 <= number < len(faces):
        found = "no face" if not len(faces) else f"{len(faces)} {'face' if len(faces) == 1 else 'faces'}"
        raise NoFaceError(
            f"image of {image.shape[-1]} x {image.shape[-2]}: found {found}, expected "
            + ("one at least" if number == 0 else f"more than {number}")
        )
    return faces


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
        detector: finds upright faces; one that states tilts is believed on top of the turn. Before the cascades, which
            know upright faces alone, the shipped network of face boxes is asked.
    """
    if isinstance(detector, HaarDetector):
        faces = find_in_quarter_turns(image, shipped_detector())
        if len(faces):
            return faces
    return _find_in_turns(image, detector)


def find_in_quarter_turns(image: Tensor, detector: FaceDetector) -> FaceBoxes:
    """Faces at every roll angle, the largest first, by a detector that states tilts but knows upright faces best.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        detector: is shown the image upright, on either side, and upside down.
    """
    height, width = image.shape[-2:]
    boxes, scores, tilts = [], [], []
    for quarters in range(4):  # counter-clockwise; a detector is shown one image at a time
        faces = find_faces(image.rot90(quarters, (-2, -1)), detector)
        sides = faces.boxes[:, 2:]
        x, y = (faces.boxes[:, :2] + sides / 2).unbind(1)
        back = ((x, y), (width - 1 - y, x), (width - 1 - x, height - 1 - y), (y, height - 1 - x))[quarters]
        boxes.append(torch.cat([torch.stack(back, 1) - sides / 2, sides], 1))
        scores.append(faces.scores)
        tilts.append(faces.tilts + quarters * math.pi / 2)
    return _joined(boxes, scores, tilts)


def _find_in_turns(image: Tensor, detector: FaceDetector) -> FaceBoxes:
    """Faces turned by about 40, 90 or 180 degrees, by a detector of upright ones."""
    grey = grey_pixels(image)
    scale = min(1.0, _TURNED_LONGEST / max(grey.shape))
    small = shrunk(grey, scale)
    size = small.shape[::-1]
    if isinstance(detector, HaarDetector):
        detector = replace(detector, **TURNED)
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
        faces = find_faces(torch.from_numpy(turned), detector)
        clear = faces.scores >= _CLEAR
        faces = FaceBoxes(faces.boxes[clear], faces.scores[clear], faces.tilts[clear])
        if not len(faces):
            continue
        at = (faces.boxes[:, :2] + faces.boxes[:, 2:] / 2).double()
        back = (((at - shift) @ turn).float() + 0.5) * ratio - 0.5
        sides = faces.boxes[:, 2:] * ratio.mean()
        boxes.append(torch.cat([back - sides / 2, sides], 1))
        scores.append(faces.scores)
        tilts.append(faces.tilts + angle)
    return _joined(boxes, scores, tilts)


def _joined(boxes: list[Tensor], scores: list[Tensor], tilts: list[Tensor]) -> FaceBoxes:
    """One face where several turns show the same: that of the highest score."""
    every, score, tilt = torch.cat(boxes), torch.cat(scores), torch.cat(tilts)
    best = one_each(every, score)
    return sorted_boxes(every[best], score[best], tilt[best])
