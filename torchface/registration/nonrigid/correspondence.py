"""Correspondences of template vertices with scan points, and those refused: border, normal, distance."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.rendering.raycast import RayCaster

_LIFT = 0.05


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Scan points for n template vertices.

    Args:
        vertices: template vertex ids, (n,) int64.
        points: u on the scan, (n,3) float64.
        normals: of the scan there, (n,3).
        weights: 0 where refused, (n,).
        distance: (n,), millimetres.
        dropped: how many were refused, by reason; a correspondence counts for the first that applies.
    """

    vertices: Tensor
    points: Tensor
    normals: Tensor
    weights: Tensor
    distance: Tensor
    dropped: dict[str, int]


def correspondences(
    current: Tensor, faces: Tensor, vertices: Tensor, scan: SurfaceIndex, reach: float, largest_angle: float
) -> Correspondences:
    r"""The nearest scan point of each template vertex, where it stands the tests.

    Refused is what lies on the scan's border, what is further than ``reach``, and where the normals differ by more
    than ``largest_angle``. The rest weighs :math:`(1 + d^2/c^2)^{-2}` (Geman and McClure) with c half the reach, so
    that hair a few centimetres off pulls little.

    Source: Amberg, Romdhani, Vetter 2007, section 4; thesis 3.2.3, figure 15.
    """
    nearest = scan.among_nearest_samples(current[vertices])
    normals = scan.normals_at(nearest)
    own = vertex_normals(current, faces)[vertices]
    far = nearest.distance > reach
    border = scan.on_border(nearest) & ~far
    turned = ((own * normals).sum(-1) < math.cos(math.radians(largest_angle))) & ~far & ~border
    scale = reach / 2
    weights = (1 + (nearest.distance / scale).square()).pow(-2).masked_fill(far | border | turned, 0.0)
    dropped = {"distance": int(far.sum()), "border": int(border.sum()), "normal": int(turned.sum())}
    return Correspondences(vertices, nearest.points, normals, weights, nearest.distance, dropped)


def exposed_vertices(vertices: Tensor, faces: Tensor, opening: float) -> Tensor:
    """Mask (V,): before which vertices nothing of the mesh itself stands within ``opening`` millimetres.

    Vertices inside the mouth, behind the lids or in no triangle have no place on a scan's surface.
    """
    normals = vertex_normals(vertices.double(), faces)
    present = normals.norm(dim=-1) > 0.5
    starts = vertices.double() + _LIFT * normals
    hits = RayCaster(vertices, faces).cast(starts.cpu(), normals.cpu())
    return present & (hits.distance > opening).to(present.device)


def evenly_spread(vertices: Tensor, candidates: Tensor, count: int) -> Tensor:
    """About ``count`` of the candidate ids (n,), spread over space: one a cell of a grid, ascending."""
    if len(candidates) <= count:
        return candidates
    points = vertices[candidates].double()
    low, high = points.amin(0), points.amax(0)
    order = torch.randperm(len(candidates), generator=torch.Generator().manual_seed(0))
    fine, coarse = float((high - low).max()) / 2000, float((high - low).max())
    chosen = candidates
    for _ in range(18):  # bisection of the cell's size
        cell = math.sqrt(fine * coarse)
        grid = ((points[order] - low) / cell).long()
        keys = (grid[:, 0] * 4096 + grid[:, 1]) * 4096 + grid[:, 2]
        _, inverse = keys.unique(return_inverse=True)
        first = torch.full((int(inverse.max()) + 1,), len(order)).scatter_reduce(
            0, inverse, torch.arange(len(order)), "amin"
        )
        if len(first) > count:
            fine = cell
        else:
            coarse, chosen = cell, candidates[order[first]]
    return chosen.sort().values
