"""Triangles drawn into a small image, nearest in front: for pictures that must be drawn faster than rays are cast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError

_SLACK = 1e-3  # pixels: neighbours overlap by this, so that no pixel on a shared edge falls between them
_LEAST_AREA = 1e-6  # square pixels, twice
_LEVEL = 1e-9


@dataclass(frozen=True, eq=False)
class DrawnPixels:
    """The pixels that a mesh covers.

    Args:
        pixel: row-major index in the image, each once, (S,) int64.
        triangle: in front there, (S,) int64.
        barycentric: of the pixel's centre in the image, three times (S,) float32.
        nearness: as the corners', interpolated, (S,) float32.
    """

    pixel: Tensor
    triangle: Tensor
    barycentric: tuple[Tensor, Tensor, Tensor]
    nearness: Tensor

    def of_vertices(self, values: Tensor, faces: Tensor) -> Tensor:
        """Values (V,) of vertices at the pixels, (S,), linear in the image."""
        corners = faces[self.triangle].unbind(1)
        first, second, third = (values[corner] * share for corner, share in zip(corners, self.barycentric, strict=True))
        return first + second + third


def rasterize(points: Tensor, nearness: Tensor, faces: Tensor, height: int, width: int) -> DrawnPixels:
    """What of a mesh each pixel of an image shows.

    Every triangle is cut into rows of pixels and each row into pixels, all at once; where several cover one, the
    nearest stays. Triangles that are seen from behind, or have a corner that is not finite, are left out.

    Args:
        points: the vertices in the image (V,2), pixels, centres at integers, x right, y down.
        nearness: larger is nearer, linear in the image, as the inverse depth is, (V,).
        faces: (F,3) int64, counter-clockwise as seen from in front.
        height, width: of the image, pixels.

    Raises:
        ShapeError: points and nearness do not fit each other, or faces are not (F,3).
    """
    if points.ndim != 2 or points.shape[1] != 2 or nearness.shape != points.shape[:1]:
        raise ShapeError(f"points: found {tuple(points.shape)} and {tuple(nearness.shape)}, expected (V,2) and (V,)")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ShapeError(f"faces: found {tuple(faces.shape)}, expected (F,3)")
    xy, near = points.detach().cpu().double().numpy(), nearness.detach().cpu().double().numpy()
    found = _Planes.of(xy[:, 0].copy(), xy[:, 1].copy(), near, faces.cpu().numpy(), height, width)
    row, column, plane = found.samples(width)
    across, down, rest = found.depth
    value = (across[plane] * column + (down[plane] * row + rest[plane])).astype(np.float32)
    pixel = row * width + column
    kept = _nearest(pixel, value, height * width)
    row, column, plane = row[kept], column[kept], plane[kept]
    first, second = (
        (a[plane] * column + (b[plane] * row + c[plane])).clip(0, 1).astype(np.float32) for a, b, c in found.edges[:2]
    )
    third = np.maximum(1 - first - second, 0)
    return DrawnPixels(
        torch.from_numpy(pixel[kept]),
        torch.from_numpy(found.triangle[plane]),
        (torch.from_numpy(first), torch.from_numpy(second), torch.from_numpy(third)),
        torch.from_numpy(value[kept]),
    )


@dataclass(frozen=True, eq=False)
class _Planes:
    """P triangles that may show, with linear functions ``a x + b y + c`` of the pixel.

    Args:
        triangle: their numbers, (P,) int64.
        edges: of each corner's barycentric coordinate a, b and c, (3,3,P).
        depth: of the nearness, (3,P).
        first, rows: the first row that each touches, and how many, (P,).
    """

    triangle: np.ndarray
    edges: np.ndarray
    depth: np.ndarray
    first: np.ndarray
    rows: np.ndarray

    @classmethod
    def of(cls, x: np.ndarray, y: np.ndarray, near: np.ndarray, faces: np.ndarray, height: int, width: int) -> _Planes:
        corners = faces.T.copy()
        (x0, x1, x2), (y0, y1, y2) = x[corners], y[corners]
        # Rows count downward: what is counter-clockwise on the mesh is clockwise here.
        with np.errstate(invalid="ignore"):
            area = (x2 - x0) * (y1 - y0) - (x1 - x0) * (y2 - y0)
        facing = np.flatnonzero((area > _LEAST_AREA) & (area < np.inf))
        (x0, x1, x2), (y0, y1, y2) = x[corners[:, facing]], y[corners[:, facing]]
        low, high = np.minimum(np.minimum(y0, y1), y2), np.maximum(np.maximum(y0, y1), y2)
        left, right = np.minimum(np.minimum(x0, x1), x2), np.maximum(np.maximum(x0, x1), x2)
        inside = (high >= 0) & (low <= height - 1) & (right >= 0) & (left <= width - 1)
        low, high, triangle = low[inside], high[inside], facing[inside]
        corners = corners[:, triangle]
        xs, ys, share = x[corners], y[corners], 1 / area[triangle]
        edges = np.empty((3, 3, len(triangle)))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            edges[i] = (ys[k] - ys[j]) * share, (xs[j] - xs[k]) * share, (xs[k] * ys[j] - xs[j] * ys[k]) * share
        first = np.ceil(low - _SLACK).clip(0, height).astype(np.int64)
        last = np.floor(high + _SLACK).clip(-1, height - 1).astype(np.int64)
        depth = (near[corners][:, None] * edges).sum(0)
        return cls(triangle, edges, depth, first, (last - first + 1).clip(0))

    def samples(self, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Row and column of every pixel that a triangle covers, and which of the P it is; each (S,) int64."""
        plane, row = _expanded(self.rows, self.first)
        left, right = np.full(len(plane), -np.inf), np.full(len(plane), np.inf)
        for a, b, c in self.edges:  # the three borders of every row
            level = np.abs(a) < _LEVEL  # such an edge bounds no row
            inverse = -1 / np.where(level, 1, a)
            crossing = (b * inverse)[plane] * row + (c * inverse)[plane]
            begins, ends = (a >= _LEVEL)[plane], (a <= -_LEVEL)[plane]
            np.maximum(left, crossing, out=left, where=begins)
            np.minimum(right, crossing, out=right, where=ends)
        begin = np.ceil(left - _SLACK).clip(0, width).astype(np.int64)
        end = np.floor(right + _SLACK).clip(-1, width - 1).astype(np.int64)
        span, column = _expanded((end - begin + 1).clip(0), begin)
        return row[span], column, plane[span]


def _expanded(counts: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each of some runs of ``counts`` whole numbers: which run, and the numbers from its first on."""
    run = np.repeat(np.arange(len(counts)), counts)
    shift = first - (np.cumsum(counts) - counts)
    return run, np.arange(len(run)) + shift[run]


def _nearest(pixel: np.ndarray, nearness: np.ndarray, count: int) -> np.ndarray:
    """Which samples are the nearest of their pixel, one a pixel."""
    best = np.full(count, -np.inf, np.float32)
    np.maximum.at(best, pixel, nearness)
    winners = np.flatnonzero(nearness >= best[pixel])
    chosen = np.full(count, -1)
    chosen[pixel[winners]] = winners  # of samples that are equally near, one
    return chosen[chosen >= 0]
