"""The face's inside cut into triangles between landmarks, and what moves with them, pixel by pixel."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import Delaunay
from torch import Tensor

_FOREHEAD = 0.9
_BROWS, _JAW, _NOSE = slice(17, 27), slice(0, 17), 30
# What is above and what is below an opening, held apart while triangles are chosen: a closed mouth or eye has no inside
# to cut. The outer lips leave space for the inner ones.
_LIPS = (((61, 49, 50), (67, 58, 59)), ((62, 51), (66, 57)), ((63, 52, 53), (65, 55, 56)))
_LIDS = (((37,), (41,)), ((38,), (40,)), ((43,), (47,)), ((44,), (46,)))


def with_forehead(landmarks: Tensor, jaw_margin: float = 0.0) -> Tensor:
    """The 68 and ten points over the brows that follow them: (B,68,2) to (B,78,2), linear; the jaw line is moved
    outward.

    Brows lie on the border of the 68; without skin above them their upper edge cannot be found.
    """
    eyes = torch.stack([landmarks[:, 36:42].mean(1), landmarks[:, 42:48].mean(1)], dim=1)
    brows = landmarks[:, _BROWS].unflatten(1, (2, 5))
    over = (brows + _FOREHEAD * (brows.mean(2) - eyes)[:, :, None]).flatten(1, 2)
    jaw = landmarks[:, _JAW] + jaw_margin * (landmarks[:, _JAW] - landmarks[:, _NOSE : _NOSE + 1])
    return torch.cat([jaw, landmarks[:, 17:], over], dim=1)


def face_triangles(shape: Tensor) -> Tensor:
    """Triangles (T,3) int64 between the 68 landmarks (68,2) and the ten points over the brows.

    A Delaunay triangulation of the shape with mouth and eyes opened, so that lips, lids and what lies between them are
    triangles of their own.
    """
    opened = shape.double().clone()
    _open(opened, _LIPS, 0.22 * float((opened[54] - opened[48]).norm()))
    _open(opened, _LIDS[:2], 0.30 * float((opened[39] - opened[36]).norm()))
    _open(opened, _LIDS[2:], 0.30 * float((opened[45] - opened[42]).norm()))
    points = with_forehead(opened[None])[0]
    triangles = torch.from_numpy(Delaunay(points.numpy()).simplices.astype(np.int64))
    rim = (triangles < 17) | (triangles >= 68)
    return triangles[~rim.all(1)]  # what lies between the jaw line and its hull is no face


def _open(shape: Tensor, pairs: Sequence[tuple[Sequence[int], Sequence[int]]], least: float) -> None:
    for upper, lower in pairs:
        lacking = max(0.0, least - float(shape[lower[0], 1] - shape[upper[0], 1]))
        shape[list(upper), 1] -= lacking / 2
        shape[list(lower), 1] += lacking / 2


@dataclass(frozen=True, eq=False)
class FaceGrid:
    """The pixels inside a reference shape."""

    pixels: Tensor  # their places (N,2)
    triangle: Tensor  # which holds each, (N,)
    barycentric: Tensor  # (N,3)
    gradient: Tensor  # what its triangle's barycentric coordinates gain a pixel along x and y, (N,3,2)


def face_grid(points: Tensor, triangles: Tensor) -> FaceGrid:
    """The whole-numbered pixels inside triangles (T,3) of a shape with points (P,2), pixels.

    Triangles without area have none. A pixel belongs to one triangle only.
    """
    points = points.double()
    corners = points[triangles]
    edges = torch.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], dim=2)
    area = torch.linalg.det(edges)
    sound = area.abs() > 1e-3
    inverse = torch.linalg.inv(torch.where(sound[:, None, None], edges, torch.eye(2, dtype=edges.dtype)))
    low, high = points.amin(0).floor(), points.amax(0).ceil()
    axes = [torch.arange(int(low[i]), int(high[i]) + 1, dtype=torch.float64) for i in (0, 1)]
    pixels = torch.stack(torch.meshgrid(*axes, indexing="xy"), dim=-1).reshape(-1, 2)
    inner = torch.einsum("tij,tnj->tni", inverse, pixels - corners[:, :1])
    weights = torch.cat([1 - inner.sum(-1, keepdim=True), inner], dim=-1)
    depth = torch.where(sound[:, None], weights.amin(-1), -torch.inf)
    best, triangle = depth.max(0)
    keep = best >= -1e-9
    triangle = triangle[keep]
    pixels = pixels[keep]
    gradient = torch.cat([-inverse.sum(1, keepdim=True), inverse], dim=1)[triangle]
    barycentric = weights[triangle, torch.nonzero(keep)[:, 0]]
    return FaceGrid(pixels.float(), triangle, barycentric.float(), gradient.float())
