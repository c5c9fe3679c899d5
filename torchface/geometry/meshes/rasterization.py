"""Triangles drawn into pixels: the texels of a layout, and pictures that must be quick, nearest in front."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError, TopologyError, ValueRangeError

_ON_EDGE = 1e-6  # texels; a centre on the edge of two triangles belongs to both
_LEAST_TEXEL_AREA = 1e-9  # square texels, twice
_MAX_OVERLAP = 64
_SLACK = 1e-3  # pixels: neighbours overlap by this, so that no pixel on a shared edge falls between them
_LEAST_AREA = 1e-6  # square pixels, twice
_LEVEL = 1e-9
# At once, so that they stay in the processor's cache: pixels of triangles, points.
_BATCH, _PIECE = 2**17, 2**14
_MARGIN = 4  # texels around the charts


@dataclass(frozen=True, eq=False)
class TexelMap:
    """The M texels of a texture that lie in a triangle; the rest of the texture is outside the charts."""

    height: int
    width: int
    texels: Tensor  # row-major indices, first row on top, ascending, (M,) int64
    triangles: Tensor  # (M,) int64
    barycentric: Tensor  # of the texel's centre in its triangle, (M,3) float64

    def interpolate(self, values: Tensor, faces: Tensor) -> Tensor:
        """Values (V,C) at triangle corners ``faces`` (F,3), interpolated at the texels, (M,C)."""
        return interpolate(values, faces[self.triangles], self.barycentric)

    def mask(self) -> Tensor:
        """(H,W) bool."""
        mask = torch.zeros(self.height * self.width, dtype=torch.bool, device=self.texels.device)
        mask[self.texels] = True
        return mask.view(self.height, self.width)

    def image(self, values: Tensor, margin: int = _MARGIN, background: Tensor | None = None) -> Tensor:
        """A texture (C,H,W) float32 of values (M,C) at the texels, a margin of the nearest, then a background or the
        mean."""
        import cv2  # loads in 0.1 s

        values = values.detach().float()
        if background is None:
            background = values.mean(0) if len(values) else torch.zeros(values.shape[1])
        texture = background[:, None].repeat(1, self.height * self.width)
        outside = (~self.mask()).numpy().astype(np.uint8)
        gap, number = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        label, reached = torch.from_numpy(number).flatten(), torch.from_numpy(gap).flatten() <= margin
        nearest = torch.zeros(int(label.max()) + 1, dtype=torch.int64)
        nearest[label[self.texels]] = torch.arange(len(values))
        if len(values):
            texture[:, reached] = values[nearest[label[reached]]].T
        return texture.view(-1, self.height, self.width)


def interpolate(values: Tensor, corners: Tensor, barycentric: Tensor) -> Tensor:
    """Values (V,C) at corners (M,3), weighted by barycentric coordinates (M,3): (M,C)."""
    # Corner by corner, some points at once: gathering (M,3,C) takes ten times the time.
    pieces = []
    for at, shares in zip(corners.split(_PIECE), barycentric.split(_PIECE), strict=True):
        piece = values[at[:, 0]] * shares[:, :1]
        for k in (1, 2):
            piece += values[at[:, k]] * shares[:, k : k + 1]
        pieces.append(piece)
    return torch.cat(pieces)


def rasterise_uvs(uvs: Tensor, uv_faces: Tensor, height: int, width: int) -> TexelMap:
    """Finds for every texel the triangle that its centre lies in.

    The centre of texel (row, column) is at :math:`u = (column + 1/2)/W`, :math:`v = 1 - (row + 1/2)/H`. Where
    triangles overlap, the first one has the texel. What lies outside the unit square is left out.
    """
    if uvs.ndim != 2 or uvs.shape[1] != 2 or uv_faces.ndim != 2 or uv_faces.shape[1] != 3:
        raise ShapeError(f"uvs: found {tuple(uvs.shape)} and {tuple(uv_faces.shape)}, expected (U,2) and (F,3)")
    if height < 1 or width < 1:
        raise ShapeError(f"texture size: found {height} x {width}, expected at least 1 x 1")
    if not torch.isfinite(uvs).all():
        bad = int((~torch.isfinite(uvs)).any(1).sum())
        raise ValueRangeError(f"uvs: {bad} of {len(uvs)} are NaN or infinite; expected none")
    upright = torch.stack([uvs[:, 0], 1 - uvs[:, 1]]).detach().cpu().double().numpy()
    points = (upright * [[width], [height]] - 0.5).clip(-1e7, 1e7)
    planes = _Planes.of(points, uv_faces.cpu().numpy(), height, width, _ON_EDGE, _LEAST_TEXEL_AREA)
    _refuse_overlap(int(planes.rows.sum()), height * width)
    owner = np.full(height * width, -1)
    plane, row, begin, count = planes.spans(width, _ON_EDGE)
    total = count.cumsum()
    pixels = int(total[-1]) if len(total) else 0
    _refuse_overlap(pixels, len(owner))
    cuts = [0, *np.searchsorted(total, np.arange(_BATCH, pixels, _BATCH)), len(count)]
    for start, stop in reversed(list(pairwise(cuts))):
        piece = slice(start, stop)
        run, column = _expanded(count[piece], begin[piece])
        texel = (row[piece] * width).take(run) + column
        owner[texel[::-1]] = plane[piece].take(run)[::-1]  # of triangles that overlap the first is written last
    texels = np.flatnonzero(owner >= 0)
    triangles = planes.triangle[owner[texels]]
    faces, barycentric = uv_faces.cpu().numpy(), np.empty((len(texels), 3))
    for first in range(0, len(texels), _PIECE):
        piece = slice(first, first + _PIECE)
        centres = np.stack([texels[piece] % width, texels[piece] // width]).astype(float)
        barycentric[piece] = _barycentric(points[:, faces[triangles[piece]]], centres)
    found = (texels, triangles, barycentric)
    return TexelMap(height, width, *(torch.from_numpy(part).to(uvs.device) for part in found))


def _barycentric(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Signed shares of the area, (M,3), of points (2,M) in triangles (2,M,3); relative to a corner, for slivers."""
    (x1, y1), (x2, y2), (x, y) = (corners[:, :, 1], corners[:, :, 2], points) - corners[:, :, 0]
    area = x1 * y2 - y1 * x2
    second, third = (x * y2 - y * x2) / area, (x1 * y - y1 * x) / area
    return np.stack([1 - second - third, second, third], axis=1)


def _refuse_overlap(work: int, texels: int) -> None:
    if work > _MAX_OVERLAP * max(texels, 2**16):
        raise TopologyError(
            f"uvs: triangles cover the texture {work / texels:.0f} times over, expected a layout whose charts "
            f"do not overlap (at most {_MAX_OVERLAP} times)"
        )


@dataclass(frozen=True, eq=False)
class DrawnPixels:
    """The pixels that a mesh covers."""

    pixel: Tensor  # row-major index in the image, each once, (S,) int64
    triangle: Tensor  # in front there, (S,) int64
    nearness: Tensor  # as the corners', interpolated, (S,) float32
    planes: "_Planes"
    # The plane and the row, float32, of each span; of each pixel its span, and its column, float32.
    at: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]

    def interpolated(self, values: Tensor) -> Tensor:
        """Values (F,3) of triangles' corners at the pixels, (S,) float32, linear in the image."""
        corners = values.numpy().take(self.planes.triangle, axis=0).T
        return torch.from_numpy(_at_pixels(self.planes.linear(corners), *self.at))


def rasterise(points: Tensor, nearness: Tensor, faces: Tensor, height: int, width: int) -> DrawnPixels:
    """What of a mesh each pixel of an image shows.

    Every triangle is cut into rows of pixels and each row into pixels, all at once; where several cover one, the
    nearest stays. Triangles that are seen from behind, or have a corner that is not finite, are left out.

    Args:
        points: the vertices in the image (V,2), pixels, centres at integers, x right, y down.
        nearness: larger is nearer, linear in the image, as the inverse depth is, (V,).
        faces: (F,3) int64, counter-clockwise as seen from in front.
    """
    if points.ndim != 2 or points.shape[1] != 2 or nearness.shape != points.shape[:1]:
        raise ShapeError(f"points: found {tuple(points.shape)} and {tuple(nearness.shape)}, expected (V,2) and (V,)")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ShapeError(f"faces: found {tuple(faces.shape)}, expected (F,3)")
    xy, near = points.detach().cpu().double().numpy().T.copy(), nearness.detach().cpu().double().numpy()
    triangles = faces.cpu().numpy()
    # Rows count downward: what is counter-clockwise on the mesh is clockwise here.
    planes = _Planes.of(xy, triangles, height, width, _SLACK, _LEAST_AREA, facing=True)
    plane, row, begin, count = planes.spans(width, _SLACK)
    span, column = _expanded(count, begin)
    pixel = (row * width).take(span)
    pixel += column
    at = plane, row.astype(np.float32), span, column.astype(np.float32)
    value = _at_pixels(planes.linear(near[triangles[planes.triangle].T]), *at)
    kept = _nearest(pixel, value, height * width)
    at = *at[:2], span.take(kept), at[3].take(kept)
    parts = (pixel.take(kept), planes.triangle.take(plane).take(at[2]), value.take(kept))
    covered, triangle, closeness = (torch.from_numpy(part) for part in parts)
    return DrawnPixels(covered, triangle, closeness, planes, at)


def _at_pixels(
    planes: np.ndarray, plane: np.ndarray, row: np.ndarray, span: np.ndarray, column: np.ndarray
) -> np.ndarray:
    """Linear functions (3,P) at pixels (S,), as ``DrawnPixels.at`` has them; float32, for speed."""
    across, down, rest = planes.astype(np.float32)
    start = down.take(plane)
    start *= row
    start += rest.take(plane)
    value = across.take(plane).take(span)
    value *= column
    value += start.take(span)
    return value


def _nearest(pixel: np.ndarray, nearness: np.ndarray, count: int) -> np.ndarray:
    """Which samples are the nearest of their pixel, one a pixel."""
    best = np.full(count, -np.inf, np.float32)
    np.maximum.at(best, pixel, nearness)
    winners = np.flatnonzero(nearness >= best.take(pixel))
    chosen = np.full(count, -1, np.int32)
    chosen[pixel[winners]] = winners  # of samples that are equally near, one
    return chosen[chosen >= 0]


@dataclass(frozen=True, eq=False)
class _Planes:
    """P triangles that may cover a pixel, with linear functions ``a x + b y + c`` of the pixel."""

    triangle: np.ndarray  # their numbers, (P,) int64
    edges: np.ndarray  # of each corner's barycentric coordinate a, b and c, (3,3,P)
    # first, rows: the first row that each touches, and how many, (P,)
    first: np.ndarray
    rows: np.ndarray

    @classmethod
    def of(
        cls,
        points: np.ndarray,
        faces: np.ndarray,
        height: int,
        width: int,
        slack: float,
        least_area: float,
        facing: bool = False,
    ) -> "_Planes":
        """Of points (2,V) and faces (F,3); with ``facing`` clockwise ones are left out, as rows count downward."""
        xs, ys = points.take(faces.T, axis=1)
        (x0, x1, x2), (y0, y1, y2) = xs, ys
        with np.errstate(invalid="ignore"):
            area = (x2 - x0) * (y1 - y0) - (x1 - x0) * (y2 - y0)
            size = area if facing else np.abs(area)
        low, high = np.minimum(np.minimum(y0, y1), y2), np.maximum(np.maximum(y0, y1), y2)
        left, right = np.minimum(np.minimum(x0, x1), x2), np.maximum(np.maximum(x0, x1), x2)
        inside = (high >= -slack) & (low <= height - 1 + slack) & (right >= -slack) & (left <= width - 1 + slack)
        triangle = np.flatnonzero((size > least_area) & (size < np.inf) & inside)
        xs, ys = xs.take(triangle, axis=1), ys.take(triangle, axis=1)
        low, high, share = low[triangle], high[triangle], 1 / area[triangle]
        edges = np.empty((3, 3, len(triangle)))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            edges[i] = (ys[k] - ys[j]) * share, (xs[j] - xs[k]) * share, (xs[k] * ys[j] - xs[j] * ys[k]) * share
        first = np.ceil(low - slack).clip(0, height).astype(np.int64)
        last = np.floor(high + slack).clip(-1, height - 1).astype(np.int64)
        return cls(triangle, edges, first, (last - first + 1).clip(0))

    def linear(self, corners: np.ndarray) -> np.ndarray:
        """Values at each triangle's corners, (3,P), as linear functions a, b and c of the pixel, (3,P)."""
        return (corners[:, None] * self.edges).sum(0)

    def spans(self, width: int, slack: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Each row of pixels of each triangle: which of the P, the row, its first column and how many pixels; (R,)
        int64, by triangle. Triangles are wider by ``slack`` pixels."""
        plane, row = _expanded(self.rows, self.first)
        left, right = np.full(len(plane), -np.inf), np.full(len(plane), np.inf)
        for a, b, c in self.edges:  # the three borders of every row
            level = np.abs(a) < _LEVEL  # such an edge bounds no row
            inverse = -1 / np.where(level, 1, a)
            crossing = (b * inverse).take(plane)  # take, and in place: half the time of brackets
            crossing *= row
            crossing += (c * inverse).take(plane)
            begins, ends = (a >= _LEVEL).take(plane), (a <= -_LEVEL).take(plane)
            np.maximum(left, crossing, out=left, where=begins)
            np.minimum(right, crossing, out=right, where=ends)
        begin = np.ceil(left - slack).clip(0, width).astype(np.int64)
        end = np.floor(right + slack).clip(-1, width - 1).astype(np.int64)
        return plane, row, begin, (end - begin + 1).clip(0)


def _expanded(counts: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each of some runs of ``counts`` whole numbers: which run, and the numbers from its first on."""
    begins = np.cumsum(counts) - counts
    total = int(counts.sum())
    # Counts of begins, summed up: for short runs np.repeat takes longer, as NumPy's own sum does.
    run = torch.from_numpy(np.bincount(begins, minlength=total)[:total]).cumsum(0).numpy()
    run -= 1
    numbers = (first - begins).take(run)
    numbers += np.arange(total)
    return run, numbers
