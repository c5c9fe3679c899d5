"""The points of a rig's surface, and points at a height above it, as affine maps of the weights."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.geometry.meshes.operators import components, vertex_normals
from torchface.rig import BlendshapeRig


@dataclass(frozen=True, eq=False)
class SurfaceMotion:
    r"""Vertices :math:`p_v(w) = A_v (1, w)` and, where asked for, their normals :math:`n_v(w) \approx N_v (1, w)`."""

    faces: Tensor
    points: Tensor  # A, (V,3,N+1), millimetres, float64
    normals: Tensor | None  # N, (V,3,N+1), float64; a shape's column is what the shape alone does to the unit normal
    skin: Tensor  # the triangles that belong to the largest connected part, (F,) bool: where markers can sit

    @staticmethod
    def of(rig: BlendshapeRig, normals: bool = False) -> "SurfaceMotion":
        """Of a rig's vertices; normals on request."""
        faces, rest = rig.neutral.faces, rig.vertices.double()
        deltas = rig.deltas.double()
        points = torch.cat([rest[..., None], deltas.permute(1, 2, 0)], dim=2)
        part = components(faces, len(rest))
        skin = (part == part[faces.flatten()].mode().values)[faces[:, 0]]
        if not normals:
            return SurfaceMotion(faces, points, None, skin)
        rest_normals = vertex_normals(rest, faces)
        # A shape at a time: all shapes' triangles at once would take a gigabyte on a large rig.
        moved = [vertex_normals(rest + delta, faces) - rest_normals for delta in deltas]
        return SurfaceMotion(faces, points, torch.stack([rest_normals, *moved], dim=2), skin)

    def lifted(self, height: float) -> Tensor:
        """Points at a height over the vertices, (V,3,N+1)."""
        if self.normals is None or height == 0:
            return self.points
        return self.points + height * self.normals

    def at(self, vertices: Tensor, sites: Attachment) -> Tensor:
        """The maps (M,3,N+1) of the sites, of those of the vertices (V,3,N+1)."""
        corners = self.faces[sites.triangles]
        return (vertices[corners] * sites.barycentric.to(vertices)[..., None, None]).sum(1)


def with_one(weights: Tensor) -> Tensor:
    """Weights (T,N) after a column of ones, (T,N+1), float64."""
    return torch.cat([weights.new_ones(len(weights), 1), weights], dim=1).double()
