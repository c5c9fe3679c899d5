"""MediaPipe's own way to follow a face, for comparison: its short-range box network where the face is lost.

Source: Bazarevsky et al. 2019, "BlazeFace"; the anchors' layout is the file's, see MediaPipe's documentation.
"""

import math
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.landmarks.images.boxes.face_box import overlaps
from torchface.landmarks.images.face_landmarker.landmarker_bundle import LandmarkerBundle
from torchface.landmarks.images.face_landmarker.mediapipe_finder import FaceLandmarker, FaceSquare, MeshFace

SIDE = 128  # pixels a side of the picture that the network is shown

_GRIDS = ((16, 2), (8, 6))  # cells a side, and anchors in the middle of each cell
_SHARED = 0.3  # overlap from which two boxes are of one face
_MOST = 100.0  # of a score's logit


def anchor_middles() -> np.ndarray:
    """Where the 896 boxes are described from, (896,2) in shares of the picture, x and y."""
    layers = []
    for cells, each in _GRIDS:
        middles = (np.arange(cells) + 0.5) / cells
        x, y = np.meshgrid(middles, middles)
        layers.append(np.stack([x, y], -1).reshape(-1, 1, 2).repeat(each, 1).reshape(-1, 2))
    return np.concatenate(layers).astype(np.float32)


def decoded(regressors: np.ndarray, logits: np.ndarray, least: float) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes that are likely faces.

    Args:
        regressors: (896,16): middle, width and height, then six points, in pixels from the anchors' middles.
        logits: (896,).
        least: score from which a box counts.

    Returns:
        Boxes x, y, width, height (F,4), points (F,6,2), both in shares of the picture, and scores (F,), best first.
    """
    scores = 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -_MOST, _MOST)))
    rows = np.flatnonzero(scores >= least)
    rows = rows[np.argsort(-scores[rows], kind="stable")]
    values = regressors[rows].reshape(len(rows), 8, 2) / SIDE
    size = values[:, 1]
    points = values + anchor_middles()[rows][:, None]
    low = points[:, 0] - size / 2
    found = torch.from_numpy(np.concatenate([low, size], 1).astype(np.float32))
    return found, torch.from_numpy(points[:, 2:]), torch.from_numpy(scores[rows].astype(np.float32))


def merged(boxes: Tensor, points: Tensor, scores: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One box a face: the mean of those that overlap its best one, weighted by score; all as of :func:`decoded`."""
    left, kept = torch.arange(len(boxes)), []
    while len(left):  # the best box decides which are of its face
        best = left[0]
        same = overlaps(boxes[best][None], boxes[left])[0] > _SHARED
        same[0] = True
        own = left[same]
        weight = scores[own] / scores[own].sum()
        kept.append(((weight[:, None] * boxes[own]).sum(0), (weight[:, None, None] * points[own]).sum(0), scores[best]))
        left = left[~same]
    if not kept:
        return boxes, points, scores
    return tuple(torch.stack(part) for part in zip(*kept, strict=True))  # type: ignore[return-value]


class MediaPipeTracker:
    """Follows one face as Face Landmarker does: in the square round its last points, by the box network where lost."""

    def __init__(self, bundle: LandmarkerBundle | str | Path) -> None:
        self.landmarker = FaceLandmarker(bundle)
        self._square: FaceSquare | None = None

    def mesh(self, image: Tensor) -> MeshFace | None:
        """The face in the next picture, uint8 (H,W) or (3,H,W), red first; None where there is none."""
        square = self._square
        if square is None:
            squares, _ = faces(self.landmarker.bundle, image)
            square = squares[0] if squares else None
        face = None if square is None else self.landmarker.look(image, square)
        present = face is not None and face.presence >= 0.5
        self._square = face.square if face is not None and present else None
        return face if present else None


def faces(bundle: LandmarkerBundle, image: Tensor) -> tuple[list[FaceSquare], Tensor]:
    """Squares of the faces in a picture, the best first, and their scores (F,)."""
    pixels = (image if image.ndim == 3 else image.expand(3, *image.shape)).permute(1, 2, 0).cpu().numpy()
    height, width = pixels.shape[:2]
    scale = SIDE / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(np.ascontiguousarray(pixels), size, interpolation=cv2.INTER_AREA if scale < 1 else 1)
    shown = np.zeros((SIDE, SIDE, 3), np.float32)  # black beside the picture, which stays in the middle
    left, top = (SIDE - size[0]) // 2, (SIDE - size[1]) // 2
    shown[top : top + size[1], left : left + size[0]] = small
    regressors, logits = bundle.boxes(shown[None] / 127.5 - 1)
    boxes, points, scores = merged(*decoded(regressors[0], logits[0, :, 0], 0.5))
    ratio, corner = torch.tensor([width / size[0], height / size[1]]), torch.tensor([left, top])
    squares = []
    for box, marks in zip(boxes * SIDE, points * SIDE, strict=True):  # a few faces
        middle = (box[:2] + box[2:] / 2 - corner) * ratio - 0.5
        across = ((marks[1] - marks[0]) * ratio).tolist()
        side = 1.5 * float(box[2:].amax() * ratio.mean())
        squares.append(FaceSquare(middle, side, math.atan2(across[1], across[0])))
    return squares, scores
