"""A raw scan as points with normals, spread evenly over its large parts."""

from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.geometry.meshes.operators import components, corners, triangle_areas, triangle_cross
from torchface.mesh import Mesh

_POINTS = 20000
_CRUMB = 0.05  # parts smaller than this share of the largest are left out


@dataclass(frozen=True, eq=False)
class SurfaceSample:
    """Points (N,3) and unit normals (N,3), float64, with a tree to find the nearest."""

    points: Tensor
    normals: Tensor
    tree: cKDTree

    def nearest(self, queries: Tensor, within: float) -> tuple[Tensor, Tensor]:
        """Distance and row of the nearest point for queries (...,3), each (...); infinity and any row beyond ``within``
        millimetres, which is what makes it fast."""
        flat = queries.reshape(-1, 3).numpy()
        distance, row = self.tree.query(flat, distance_upper_bound=within, workers=-1)
        shape = queries.shape[:-1]
        rows = torch.from_numpy(row).clamp(max=len(self.points) - 1)
        return torch.from_numpy(distance).view(shape), rows.view(shape)


def sample_surface(mesh: Mesh) -> SurfaceSample:
    """Area-weighted random points on a scan's large connected parts, normals made to point outward.

    Normals that point inward on the whole (a scan turned inside out) are flipped: those of a head point away from the
    middle of its points more often than toward it.
    """
    vertices = mesh.vertices.detach().cpu().double()
    faces = mesh.faces.cpu()
    area = triangle_areas(vertices, faces)
    if len(faces) == 0 or not float(area.sum()) > 0:
        raise ValueRangeError(f"scan: found {len(faces)} triangles without area, expected a surface")
    part = components(faces, len(vertices))[faces[:, 0]]
    part_area = torch.zeros(int(part.max()) + 1, dtype=torch.float64).index_add_(0, part, area)
    area = area * (part_area >= _CRUMB * part_area.max())[part]
    generator = torch.Generator().manual_seed(0)
    pick = torch.searchsorted(
        area.cumsum(0), torch.rand(_POINTS, generator=generator, dtype=torch.float64) * area.sum()
    )
    pick = pick.clamp(max=len(faces) - 1)
    first, second = torch.rand(2, _POINTS, 1, generator=generator, dtype=torch.float64)
    root = first.sqrt()
    a, b, c = corners(vertices, faces[pick])
    points = (1 - root) * a + root * (1 - second) * b + root * second * c
    normals = torch.nn.functional.normalize(triangle_cross(vertices, faces[pick]), dim=-1, eps=1e-20)
    if float(((points - points.mean(0)) * normals).sum(-1).sign().sum()) < 0:
        normals = -normals
    return SurfaceSample(points, normals, cKDTree(points.numpy()))
