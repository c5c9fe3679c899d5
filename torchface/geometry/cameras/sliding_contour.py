"""Outline of a face before the background: points that slide over the skin as the head rotates."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError

_START_MARGIN = 2.0  # millimetres by which a curve may lie behind the point that it starts from, or beyond the midline


@dataclass(frozen=True, eq=False)
class LevelCurves:
    """Curves over the skin at constant height, one for each of J points, as points on mesh edges.

    They are fixed in the material: on another face of the same topology they lie on the same edges.
    """

    vertices: Tensor  # both ends of the edge of each point, (J,C,2) int64; the first point is the start itself
    share: Tensor  # how far along the edge, (J,C)
    valid: Tensor  # (J,C) bool; shorter curves are padded with their start
    side: Tensor  # +1 where a curve lies on the side of positive x, -1, or 0 on the midline, (J,)

    def interpolate(self, values: Tensor) -> Tensor:
        """Values (V,...) of vertices at the curves' points, (J,C,...)."""
        ends = values[self.vertices]
        share = self.share.to(values).reshape(*self.share.shape, *[1] * (values.ndim - 1))
        return ends[:, :, 0] * (1 - share) + ends[:, :, 1] * share


def level_curves(vertices: Tensor, faces: Tensor, starts: Tensor) -> LevelCurves:
    """From vertices (J,) at the side of an upright face to its midline, not behind it, each at the height of its
    start."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or starts.ndim != 1:
        raise ShapeError(
            f"level_curves: found vertices {tuple(vertices.shape)}, faces {tuple(faces.shape)}, starts "
            f"{tuple(starts.shape)}, expected (V,3), (F,3) and (J,)"
        )
    x = vertices.detach().double().cpu()
    first, second = _edges_once(faces.cpu())
    begin = x[starts.cpu()]
    middle = begin[:, 0].abs() < _START_MARGIN
    side = begin[:, 0].sign().masked_fill(middle, 0.0)
    below = x[:, 1] < begin[:, 1:2]
    crossed = (below[:, first] != below[:, second]) & ~middle[:, None]
    curve, edge = crossed.nonzero().T
    a, b, start = x[first[edge]], x[second[edge]], begin[curve]
    share = (start[:, 1] - a[:, 1]) / (b[:, 1] - a[:, 1])
    points = a + share[:, None] * (b - a)
    outward = points[:, 0] * side[curve]
    kept = (outward > -_START_MARGIN) & (points[:, 2] > start[:, 2] - _START_MARGIN)
    curve, edge, share = curve[kept], edge[kept], share[kept]
    count = curve.bincount(minlength=len(starts))
    place = torch.arange(len(curve)) - torch.repeat_interleave(count.cumsum(0) - count, count) + 1
    size = (len(starts), int(count.max()) + 1 if len(count) else 1)
    ends = starts.cpu()[:, None, None].expand(*size, 2).clone()
    along, valid = torch.zeros(size, dtype=torch.float64), torch.zeros(size, dtype=torch.bool)
    ends[curve, place] = torch.stack([first[edge], second[edge]], dim=1)
    along[curve, place] = share
    valid[curve, place] = True
    valid[:, 0] = True
    return LevelCurves(ends, along, valid, side)


def _edges_once(faces: Tensor) -> tuple[Tensor, Tensor]:
    """Both ends of every edge; on a surface whose triangles are oriented alike an edge inside it runs once each way."""
    first, second = faces.flatten(), faces.roll(-1, 1).flatten()
    kept = first < second
    return first[kept], second[kept]


def outermost(pixels: Tensor, valid: Tensor, outward: Tensor) -> Tensor:
    """The point of each curve that is seen furthest out along (B,J,2): the rows (B,J) of those of (B,J,C,2) that are
    valid.

    A direction of zero means the curve's start.
    """
    reach = (pixels * outward[:, :, None]).sum(-1).masked_fill(~valid, -torch.inf)
    furthest = reach.argmax(-1)
    return torch.where((outward == 0).all(-1), 0, furthest)
