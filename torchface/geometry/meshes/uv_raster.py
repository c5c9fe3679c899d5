"""Which triangle lies under each texel of a texture, and where in it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, TopologyError, ValueRangeError

_ON_EDGE = 1e-6  # texels; a centre on the edge of two triangles belongs to both
_DEGENERATE = 1e-9  # square texels
_MAX_OVERLAP = 64
_BATCH = 2**22


@dataclass(frozen=True, eq=False)
class TexelMap:
    """The M texels of a texture that lie in a triangle; the rest of the texture is outside the charts.

    Args:
        height, width: of the texture.
        texels: row-major indices, first row on top, ascending, (M,) int64.
        triangles: (M,) int64.
        barycentric: of the texel's centre in its triangle, (M,3) float64.
    """

    height: int
    width: int
    texels: Tensor
    triangles: Tensor
    barycentric: Tensor

    def interpolate(self, values: Tensor, faces: Tensor) -> Tensor:
        """Values (V,C) at triangle corners ``faces`` (F,3), interpolated at the texels, (M,C)."""
        return interpolate(values, faces[self.triangles], self.barycentric)

    def mask(self) -> Tensor:
        """(H,W) bool."""
        mask = torch.zeros(self.height * self.width, dtype=torch.bool, device=self.texels.device)
        mask[self.texels] = True
        return mask.view(self.height, self.width)


def interpolate(values: Tensor, corners: Tensor, barycentric: Tensor) -> Tensor:
    """Values (V,C) at corners (M,3), weighted by barycentric coordinates (M,3): (M,C)."""
    # Corner by corner: gathering (M,3,C) first takes thrice the time.
    result = values[corners[:, 0]] * barycentric[:, :1]
    for k in (1, 2):
        result += values[corners[:, k]] * barycentric[:, k : k + 1]
    return result


def rasterise_uvs(uvs: Tensor, uv_faces: Tensor, height: int, width: int) -> TexelMap:
    """Finds for every texel the triangle that its centre lies in.

    The centre of texel (row, column) is at :math:`u = (column + 1/2)/W`, :math:`v = 1 - (row + 1/2)/H`. Where
    triangles overlap, the first one has the texel. What lies outside the unit square is left out.

    Args:
        uvs: texture coordinates, origin at the lower left, (U,2).
        uv_faces: their rows at each triangle's corners, (F,3) int64.
        height, width: texels.

    Raises:
        ShapeError: a tensor has the wrong shape, or a side is not positive.
        ValueRangeError: a texture coordinate is NaN or infinite.
        TopologyError: triangles overlap so much that this is no layout.
    """
    if uvs.ndim != 2 or uvs.shape[1] != 2 or uv_faces.ndim != 2 or uv_faces.shape[1] != 3:
        raise ShapeError(f"uvs: found {tuple(uvs.shape)} and {tuple(uv_faces.shape)}, expected (U,2) and (F,3)")
    if height < 1 or width < 1:
        raise ShapeError(f"texture size: found {height} x {width}, expected at least 1 x 1")
    if not torch.isfinite(uvs).all():
        bad = int((~torch.isfinite(uvs)).any(1).sum())
        raise ValueRangeError(f"uvs: {bad} of {len(uvs)} are NaN or infinite; expected none")
    scale = torch.tensor([width, height], dtype=torch.float64, device=uvs.device)
    upright = torch.stack([uvs[:, 0], 1 - uvs[:, 1]], dim=1).double()
    corners = (upright * scale - 0.5).clamp(-1e7, 1e7)[uv_faces]
    solid = (_doubled_area(corners).abs() > _DEGENERATE).nonzero()[:, 0]
    owner = torch.full((height * width,), len(uv_faces), dtype=torch.int64, device=uvs.device)
    rows = _row_spans(corners[solid], height, width)
    _fill(owner, *rows, solid, width)
    texels = (owner < len(uv_faces)).nonzero()[:, 0]
    triangles = owner[texels]
    del owner
    return TexelMap(height, width, texels, triangles, _barycentric(corners, triangles, texels, width))


def _doubled_area(corners: Tensor) -> Tensor:
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _row_spans(corners: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Each triangle cut into texel rows: triangle, row, first and last column, all (S,)."""
    y = corners[..., 1]
    first = (y.amin(1) - _ON_EDGE).ceil().clamp(min=0).long()
    last = (y.amax(1) + _ON_EDGE).floor().clamp(max=height - 1).long()
    count = (last - first + 1).clamp(min=0)
    _refuse_overlap(int(count.sum()), height * width)
    triangle = torch.repeat_interleave(torch.arange(len(corners), device=corners.device), count)
    row = first[triangle] + _position_in_run(count)
    low = torch.full(row.shape, torch.inf, dtype=torch.float64, device=corners.device)
    high = -low
    for k in range(3):
        a, b = corners[triangle, k], corners[triangle, (k + 1) % 3]
        rise = b[:, 1] - a[:, 1]
        crossed = (torch.minimum(a[:, 1], b[:, 1]) <= row + _ON_EDGE) & (
            torch.maximum(a[:, 1], b[:, 1]) >= row - _ON_EDGE
        )
        level = rise.abs() < _ON_EDGE
        along = ((row - a[:, 1]) / torch.where(level, 1.0, rise)).clamp(0, 1)
        x = a[:, 0] + torch.where(level, 0.0, along) * (b[:, 0] - a[:, 0])
        end = torch.where(level, b[:, 0], x)
        low = torch.where(crossed, torch.minimum(low, torch.minimum(x, end)), low)
        high = torch.where(crossed, torch.maximum(high, torch.maximum(x, end)), high)
    left = (low - _ON_EDGE).ceil().clamp(0, width).long()
    right = (high + _ON_EDGE).floor().clamp(-1, width - 1).long()
    return triangle, row, left, right


def _fill(owner: Tensor, triangle: Tensor, row: Tensor, left: Tensor, right: Tensor, names: Tensor, width: int) -> None:
    count = (right - left + 1).clamp(min=0)
    total = count.cumsum(0)
    if len(total) == 0:
        return
    _refuse_overlap(int(total[-1]), len(owner))
    # Batches bound the memory; within one every span is filled at once.
    cuts = torch.arange(_BATCH, int(total[-1]) + _BATCH, _BATCH, device=total.device)
    ends = torch.searchsorted(total, cuts, right=True).tolist()
    start = 0
    for end in [*ends, len(total)]:
        if end <= start:
            continue
        piece = slice(start, end)
        columns = torch.repeat_interleave(left[piece], count[piece]) + _position_in_run(count[piece])
        texel = torch.repeat_interleave(row[piece] * width, count[piece]) + columns
        name = torch.repeat_interleave(names[triangle[piece]], count[piece])
        owner.scatter_reduce_(0, texel, name, "amin")
        start = end


def _position_in_run(count: Tensor) -> Tensor:
    """0, 1, ... within each run."""
    ends = count.cumsum(0)
    total = int(ends[-1]) if len(ends) else 0
    return torch.arange(total, device=count.device) - torch.repeat_interleave(ends - count, count)


def _refuse_overlap(work: int, texels: int) -> None:
    if work > _MAX_OVERLAP * max(texels, 2**16):
        raise TopologyError(
            f"uvs: triangles cover the texture {work / texels:.0f} times over, expected a layout whose charts "
            f"do not overlap (at most {_MAX_OVERLAP} times)"
        )


def _barycentric(corners: Tensor, triangles: Tensor, texels: Tensor, width: int) -> Tensor:
    """Signed shares of the area, (M,3)."""
    a, b, c = corners[triangles].unbind(1)
    x, y = (texels % width).double(), torch.div(texels, width, rounding_mode="floor").double()
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    second = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (y - a[:, 1]) * (c[:, 0] - a[:, 0])) / area
    third = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (b[:, 1] - a[:, 1]) * (x - a[:, 0])) / area
    return torch.stack([1 - second - third, second, third], dim=1)
