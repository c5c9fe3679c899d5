"""Checks of how much detail photographs show of a face: blur and compression, with their measures."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from torch import Tensor
from torch.nn.functional import avg_pool2d

# Points between the outer corners of the eyes: 12 faces in sharp photographs 19 to 47, blurred by a Gaussian of 2 % of
# that distance at most 16, faces 60 pixels wide in five webcams' films 11 to 15. Smaller faces are warned of as such.
_LEAST_POINTS, _FEW_EYES = 18.0, 30.0
_LARGE = 70.0  # pixels between these corners: of larger faces pixels are averaged, so that grain is no detail
_EDGES, _LEAST_STEP, _BLUR = 0.9, 1e-3, 1.0  # quantile of steps and the least; pixels by which they are blurred again
_FULL_WIDTH = 2.355  # at half height, in deviations of a Gaussian
# Of the mean step from pixel to pixel: 29 faces at most 0.37, as JPEG of quality 30 at most 1.06, 20 at most 1.5, 10 at
# least 0.84 and in 25 of 29 above 1.1, 5 at least 1.57.
_BLOCKY, _BLOCK, _LEAST_BLOCKS = 1.1, 8, 3


def sharpness_lines(photographs: Sequence[Path], images: Sequence[Tensor], landmarks: Tensor) -> list[str]:
    """Which photographs (3,H,W) are blurred or heavily compressed within faces with landmarks (I,68,2), for people to
    read; nothing where they are sharp."""
    blurred, blocky = [], []
    for path, image, marks in zip(photographs, images, landmarks.double(), strict=True):
        eyes = float((marks[36] - marks[45]).norm())
        light = image[:3].clamp(0, 1).mean(0)
        points = resolved_points(light, marks) if eyes >= _FEW_EYES else _LEAST_POINTS
        if points < _LEAST_POINTS:
            blurred.append(f"{path.name} resolves {points:.0f}")
        blocks = blockiness(light, marks)
        if blocks > _BLOCKY:
            blocky.append(f"{path.name} {blocks:.1f}")
    lines = []
    if blurred:
        lines.append(
            f"WARNING: blurred (out of focus, moved, enlarged?): {', '.join(blurred)} points between the eyes' outer "
            f"corners, expected at least {_LEAST_POINTS:.0f}: brows, eyes and skin come out smeared, their landmarks "
            "are less sure; give a sharper picture"
        )
    if blocky:
        lines.append(
            f"WARNING: heavily compressed (steps at the edges of blocks of {_BLOCK} pixels beside the mean step: "
            f"{', '.join(blocky)}, expected at most {_BLOCKY}): the blocks show in the skin; give the picture as taken"
        )
    return lines


def resolved_points(light: Tensor, marks: Tensor) -> float:
    """How many points a picture (H,W) resolves between the outer corners of the eyes, of landmarks (68,2), along its
    rows or columns, where they are fewer.

    Their distance over the width of the face's strong edges, found by how much weaker another blur makes these.

    Source: Zhuo and Sim 2011 (defocus from re-blurred edges).
    """
    eyes = float((marks[36] - marks[45]).norm())
    scale = max(1, round(eyes / _LARGE))
    small = avg_pool2d(light[None, None].float(), scale)[0, 0].numpy()
    at = ((marks[marks.isfinite().all(-1)] + 0.5) / scale - 0.5).round().int().numpy()
    face = cv2.fillConvexPoly(np.zeros(small.shape, np.uint8), cv2.convexHull(at), 1) > 0
    again, ratios = cv2.GaussianBlur(small, (0, 0), _BLUR), list[float]()
    for along in ((1, 0), (0, 1)) if face.any() else ():
        before, after = (np.abs(cv2.Sobel(one, cv2.CV_32F, *along)) for one in (small, again))
        edge = face & (before > max(np.quantile(before[face], _EDGES), _LEAST_STEP))
        ratios.append(float(np.median(before[edge] / after[edge])) if edge.any() else 1.0)
    width = _FULL_WIDTH * _BLUR / max(min(ratios, default=1.0) ** 2 - 1, 1e-4) ** 0.5
    return eyes / (scale * width)


def blockiness(light: Tensor, marks: Tensor) -> float:
    """How much a picture (H,W) steps at the edges of a grid of blocks, as JPEG's, beyond beside them, in mean steps.

    Within a face's box, by the grid's likeliest place; 0 of a face too small to say.
    """
    known = marks[marks.isfinite().all(-1)]
    (left, top), (right, bottom) = known.amin(0).clamp(min=0).long().tolist(), (known.amax(0) + 1).long().tolist()
    face = light[top:bottom, left:right]
    if min(face.shape) <= _LEAST_BLOCKS * _BLOCK:
        return 0.0
    found = []
    for axis in (0, 1):
        steps = face.diff(dim=axis).abs().mean(1 - axis)
        beyond = steps[1:-1] - (steps[:-2] + steps[2:]) / 2
        most = max(float(beyond[place::_BLOCK].mean()) for place in range(_BLOCK))
        found.append(most / max(float(steps.mean()), 1e-6))
    return float(np.mean(found))
