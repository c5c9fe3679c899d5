r"""The frames in which a normal map speaks: MikkTSpace's, as Blender, Unreal and glTF viewers compute them.

At a point of a mesh the frame is :math:`(T, B, N)`: the interpolated vertex normal N, the interpolated tangent T along
growing u, and :math:`B = \sigma\, N \times T` along growing v (v grows upward in the image: "+Y up", OpenGL's and
glTF's convention), :math:`\sigma = -1` where the texture is mirrored. Nothing is renormalised between vertices, as in
MikkTSpace's reference shader, and a map value t stands for the direction :math:`t_x T + t_y B + t_z N`.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.meshes.operators import corners
from torchface.geometry.meshes.rasterization import interpolate


@dataclass(frozen=True, eq=False)
class TangentSpace:
    """Tangents of a mesh; a vertex on a seam or between mirrored halves has several."""

    normals: Tensor  # unit, (V,3)
    tangents: Tensor  # unit and perpendicular to the normal, (C,3)
    signs: Tensor  # of the bitangent, (C,)
    faces: Tensor  # vertices at each triangle's corners, (F,3)
    tangent_faces: Tensor  # rows of tangents at each triangle's corners, (F,3)

    def frames(self, triangles: Tensor, barycentric: Tensor) -> Tensor:
        """Columns T, B, N at points of triangles (M,) with barycentric coordinates (M,3): (M,3,3)."""
        weight = barycentric.to(self.normals)
        rows = self.tangent_faces[triangles]
        normal = interpolate(self.normals, self.faces[triangles], weight)
        tangent = interpolate(self.tangents, rows, weight)
        bitangent = self.signs[rows[:, :1]] * torch.linalg.cross(normal, tangent)
        return torch.stack([tangent, bitangent, normal], dim=-1)


def tangent_space(vertices: Tensor, faces: Tensor, uvs: Tensor, uv_faces: Tensor, normals: Tensor) -> TangentSpace:
    """Tangents by MikkTSpace's rule: each triangle's direction of growing u, laid into the vertex's tangent plane,
    averaged by corner angle over the triangles that share vertex, texture coordinate and orientation.

    Where a triangle has no extent in the texture it is ignored; a vertex of such triangles only gets any tangent.

    Source: Mikkelsen 2008, Simulation of Wrinkled Surfaces Revisited; glTF 2.0 specification, 3.7.2.1 and 3.9.3.
    """
    direction, sign = _directions(vertices, faces, uvs, uv_faces)
    rows, tangent_faces, signs = _shared_corners(faces, uvs, uv_faces, sign)
    total = torch.zeros(len(signs), 3, dtype=vertices.dtype, device=vertices.device)
    points = corners(vertices, faces)
    for k in range(3):
        normal = normals[faces[:, k]]
        angle = _angle(
            _in_plane(points[(k + 1) % 3] - points[k], normal), _in_plane(points[(k + 2) % 3] - points[k], normal)
        )
        total.index_add_(0, tangent_faces[:, k], angle * _in_plane(direction, normal))
    normal = normals[rows]
    return TangentSpace(normals, _with_fallback(_in_plane(total, normal), normal), signs, faces, tangent_faces)


def _directions(vertices: Tensor, faces: Tensor, uvs: Tensor, uv_faces: Tensor) -> tuple[Tensor, Tensor]:
    """Unit direction of growing u (F,3), zero where the texture is a line, and orientation (F,) as 1 or -1."""
    a, b, c = corners(vertices, faces)
    ta, tb, tc = corners(uvs.to(vertices), uv_faces)
    first, second = tb - ta, tc - ta
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    along = second[:, 1:] * (b - a) - first[:, 1:] * (c - a)
    sign = torch.where(area < 0, -1.0, 1.0).to(vertices)
    direction = sign[:, None] * torch.nn.functional.normalize(along, dim=-1, eps=1e-20)
    return torch.where(area[:, None] == 0, 0.0, direction), sign


def _shared_corners(faces: Tensor, uvs: Tensor, uv_faces: Tensor, sign: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Corners that share a tangent: its vertex (C,), the rows at each corner (F,3), its sign (C,)."""
    # By value: files may list the same texture coordinate twice, which makes no seam.
    _, same = uvs.unique(dim=0, return_inverse=True)
    span = len(uvs)
    keys = ((faces * span + same[uv_faces]) * 2 + (sign > 0)[:, None].long()).flatten()
    unique, rows = keys.unique(return_inverse=True)
    return unique // 2 // span, rows.view(-1, 3), ((unique % 2) * 2 - 1).to(sign)


def _in_plane(vectors: Tensor, normals: Tensor) -> Tensor:
    flat = vectors - normals * (vectors * normals).sum(-1, keepdim=True)
    return torch.nn.functional.normalize(flat, dim=-1, eps=1e-20)


def _angle(first: Tensor, second: Tensor) -> Tensor:
    return torch.acos((first * second).sum(-1, keepdim=True).clamp(-1, 1))


def _with_fallback(tangents: Tensor, normals: Tensor) -> Tensor:
    lost = tangents.norm(dim=-1, keepdim=True) < 0.5
    axis = torch.nn.functional.one_hot(normals.abs().argmin(-1), 3).to(normals)
    return torch.where(lost, _in_plane(axis, normals), tangents)


def to_tangent_space(frames: Tensor, directions: Tensor) -> Tensor:
    """Directions (M,3) as unit coordinates in frames (M,3,3); zero where the frame has collapsed."""
    tangent, bitangent, normal = frames.unbind(-1)
    across = torch.linalg.cross(bitangent, normal)
    determinant = (tangent * across).sum(-1)
    rows = torch.stack([across, torch.linalg.cross(normal, tangent), torch.linalg.cross(tangent, bitangent)], dim=1)
    coordinates = (rows @ directions[..., None])[..., 0] * determinant.sign()[:, None]
    return torch.nn.functional.normalize(coordinates, dim=-1, eps=1e-20)


def from_tangent_space(frames: Tensor, coordinates: Tensor) -> Tensor:
    """Unit directions (M,3) of coordinates (M,3) in frames (M,3,3)."""
    return torch.nn.functional.normalize((frames @ coordinates[..., None])[..., 0], dim=-1, eps=1e-20)
