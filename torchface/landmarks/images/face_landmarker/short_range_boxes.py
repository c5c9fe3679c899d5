"""Anchors of MediaPipe's short-range face detector, its boxes decoded, and those of one face merged.

Source: Bazarevsky et al. 2019, "BlazeFace"; the anchors' layout is the file's, see MediaPipe's documentation.
"""

import numpy as np
import torch
from torch import Tensor

from torchface.landmarks.images.boxes.face_box import overlaps

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
