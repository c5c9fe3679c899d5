"""Frames of a smooth deformation: rotation and stretch at every vertex, and in the mean over patches."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.enhancement.detail.low_pass import vertex_areas
from torchface.enhancement.detail.polar_parts import encode_gradients
from torchface.enhancement.detail.sparse_operator import SparseOperator
from torchface.geometry.meshes.deformation import gradient_operator
from torchface.geometry.meshes.operators import edges, triangle_areas, vertex_normals


@dataclass(frozen=True, eq=False)
class TurnedFrames:
    """The rest frame of every vertex, turned with the surface."""

    axes: Tensor  # two tangents and the normal, (3,3,V,B): axis, coordinate, vertex, frame

    def to_world(self, local: Tensor) -> Tensor:
        """Vectors (B,3,V), given along the axes, as vectors of space (B,V,3)."""
        first, second, normal = self.axes
        a, b, c = local.permute(1, 2, 0)
        return (first * a + second * b + normal * c).permute(2, 1, 0)

    def to_local(self, vectors: Tensor) -> Tensor:
        """Vectors of space (B,V,3) along the axes, (B,3,V)."""
        x, y, z = vectors.permute(2, 1, 0)
        along = [axis[0] * x + axis[1] * y + axis[2] * z for axis in self.axes]
        return torch.stack(along).permute(2, 0, 1)


class SurfaceFrames:
    r"""Tangents and normal of every vertex under a deformation, by one product with a sparse matrix.

    With :math:`T` a vertex's two tangents at rest and :math:`\bar A` the mean of its triangles' gradient operators,
    weighted by area, the tangents' images are :math:`J = T + (T^\top \bar P T)^{-1} T^\top \bar A u` for displacements
    u; the normal is their cross product, and the turned frame the orthonormal one nearest to J, in closed form.
    """

    def __init__(self, neutral: Tensor, faces: Tensor) -> None:
        rest, faces = neutral.detach().double().cpu(), faces.cpu()
        self._areas = vertex_areas(rest, faces).numpy()
        self.rest_axes = _rest_axes(rest, faces)
        around = _mean_over_triangles(rest, faces)
        self._tangents = sparse.csr_array(_tangent_operator(rest, faces, around, self.rest_axes[:2].numpy()))
        self._operator = SparseOperator(self._tangents)

    def turned(self, displacements: Tensor) -> TurnedFrames:
        """The frames under displacements (B,V,3); differentiable."""
        first, second = self._images(displacements)
        E, G, F = _dot(first, first), _dot(second, second), _dot(first, second)
        # A surface that collapses has no tangents: its frame shrinks to nothing instead of growing without bound.
        root = (E * G - F * F).clamp(min=1e-8).sqrt()
        scale = 1 / (root * (E + G + 2 * root).sqrt())
        normal = _cross(first, second) / root
        axes = (first * (G + root) - second * F) * scale, (second * (E + root) - first * F) * scale, normal
        return TurnedFrames(torch.stack(axes))

    def patch_gradients(self, patches: Tensor, faces: Tensor, neutral: Tensor) -> "PatchGradients":
        """What takes the mean gradients over patches of triangles."""
        shares = _patch_shares(
            patches, triangle_areas(neutral.detach().double().cpu(), faces.cpu()), faces, len(neutral)
        )
        return PatchGradients(self, shares, self._tangents)

    def _images(self, displacements: Tensor) -> tuple[Tensor, Tensor]:
        count, vertices, _ = displacements.shape
        columns = displacements.permute(1, 2, 0).reshape(vertices, 3 * count)
        moved = self._operator(columns).view(2, vertices, 3, count).permute(0, 2, 1, 3)
        first, second = moved + self.rest_axes[:2].transpose(1, 2).to(moved)[..., None]
        return first.contiguous(), second.contiguous()


class PatchGradients:
    r"""Deformation gradients in the mean over patches, as nine numbers each.

    A vertex's gradient is :math:`J T^\top + n' n^\top`. Its tangential part is linear in the displacements, so its
    means are too: no gradient of a single vertex is ever formed.

    Args:
        shares: of the vertices in the patches, (P,V), rows of sum 1.
    """

    def __init__(self, frames: SurfaceFrames, shares: sparse.csr_array, tangents: sparse.csr_array) -> None:
        self.count = shares.shape[0]
        vertices = shares.shape[1]
        axes = frames.rest_axes.numpy()
        by_axis = [
            sum(
                shares
                @ sparse.diags_array(axes[tangent][:, axis])
                @ tangents[tangent * vertices : (tangent + 1) * vertices]
                for tangent in (0, 1)
            )
            for axis in range(3)
        ]
        self._tangential = SparseOperator(sparse.vstack(by_axis))
        normals = [shares @ sparse.diags_array(axes[2][:, axis]) for axis in range(3)]
        self._normal = SparseOperator(sparse.vstack(normals))
        self._rest_normals = frames.rest_axes[2]
        self.means = SparseOperator(shares)

    def features(self, displacements: Tensor, turned: TurnedFrames) -> Tensor:
        """Rotation vector and stretch of every patch, (B,P,9), of displacements (B,V,3); zeros at rest."""
        count, vertices, _ = displacements.shape
        columns = displacements.permute(1, 2, 0).reshape(vertices, 3 * count)
        normals = turned.axes[2] - self._rest_normals.T.to(displacements)[..., None]
        change = self._tangential(columns) + self._normal(normals.permute(1, 0, 2).reshape(vertices, 3 * count))
        # Rows are rest axes, columns coordinates: the transpose is the gradient.
        gradients = change.view(3, self.count, 3, count).permute(3, 1, 2, 0)
        return encode_gradients(gradients + torch.eye(3).to(gradients))

    def motion(self, displacements: Tensor) -> Tensor:
        """Mean displacements of the patches, (B,P,3)."""
        count, vertices, _ = displacements.shape
        means = self.means(displacements.permute(1, 2, 0).reshape(vertices, 3 * count))
        return means.view(self.count, 3, count).permute(2, 0, 1)


def _dot(first: Tensor, second: Tensor) -> Tensor:
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


def _cross(first: Tensor, second: Tensor) -> Tensor:
    (a, b, c), (d, e, f) = first, second
    return torch.stack([b * f - c * e, c * d - a * f, a * e - b * d])


def _rest_axes(rest: Tensor, faces: Tensor) -> Tensor:
    """Two tangents and the normal of every vertex, (3,V,3); those of a loose vertex are the axes of space.

    The first tangent goes towards the neighbour of the least number, so heads of one mesh have the same axes, and they
    turn with the head.
    """
    count = len(rest)
    pairs = edges(faces)
    towards = torch.full((count,), count).scatter_reduce(0, pairs.flip(1).flatten(), pairs.flatten(), "amin")
    loose = towards == count
    way = rest[towards.masked_fill(loose, 0)] - rest
    normals = vertex_normals(rest, faces)
    normals = torch.where(normals.norm(dim=1, keepdim=True) > 0.5, normals, torch.tensor([0.0, 0.0, 1.0]).to(normals))
    first = way - (way * normals).sum(1, keepdim=True) * normals
    bad = loose | (first.norm(dim=1) < 1e-3 * way.norm(dim=1).clamp(min=1e-9))
    aside = torch.zeros_like(normals).scatter_(1, normals.abs().argmin(1, keepdim=True), 1.0)
    first = torch.where(bad[:, None], torch.linalg.cross(aside, normals), first)
    first = torch.nn.functional.normalize(first, dim=1, eps=1e-30)
    return torch.stack([first, torch.linalg.cross(normals, first), normals])


def _mean_over_triangles(rest: Tensor, faces: Tensor) -> sparse.csr_array:
    """Means over the triangles around each vertex, weighted by area, (V,F)."""
    areas = triangle_areas(rest, faces).numpy().repeat(3)
    triangle = np.arange(len(faces)).repeat(3)
    total = sparse.coo_array((areas, (faces.numpy().ravel(), triangle)), shape=(len(rest), len(faces))).tocsr()
    sums = total.sum(axis=1)
    return sparse.csr_array(sparse.diags_array(np.where(sums > 0, 1 / np.where(sums > 0, sums, 1), 0)) @ total)


def _tangent_operator(rest: Tensor, faces: Tensor, around: sparse.csr_array, tangents: np.ndarray) -> sparse.sparray:
    """The change of both tangents' images for displacements, (2V,V)."""
    vertices, triangles = len(rest), len(faces)
    gradients = gradient_operator(rest, faces)
    by_axis = [around @ gradients[axis::3] for axis in range(3)]
    normal = torch.linalg.cross(rest[faces[:, 1]] - rest[faces[:, 0]], rest[faces[:, 2]] - rest[faces[:, 0]])
    normal = torch.nn.functional.normalize(normal, dim=1).numpy()
    outer = (around @ (normal[:, :, None] * normal[:, None, :]).reshape(triangles, 9)).reshape(vertices, 3, 3)
    # Triangles do not lie in the vertex's tangent plane: what their gradients miss of it is put right.
    kept = np.eye(2) - np.einsum("avi,vij,bvj->vab", tangents, outer, tangents)
    kept = np.linalg.inv(np.where(np.linalg.det(kept)[:, None, None] > 0.05, kept, np.eye(2)))
    along = np.einsum("vab,bvi->avi", kept, tangents)
    return sparse.vstack(
        [sum(sparse.diags_array(along[a][:, axis]) @ by_axis[axis] for axis in range(3)) for a in (0, 1)]
    )


def _patch_shares(patches: Tensor, areas: Tensor, faces: Tensor, vertex_count: int) -> sparse.csr_array:
    """The part that each vertex has in each patch, by the area of its triangles there, (P,V), rows of sum 1."""
    weight = (areas / 3).clamp(min=1e-12).numpy().repeat(3)
    patch = patches.cpu().numpy().repeat(3)
    shape = (int(patches.max()) + 1, vertex_count)
    total = sparse.coo_array((weight, (patch, faces.cpu().numpy().ravel())), shape=shape).tocsr()
    return sparse.csr_array(sparse.diags_array(1 / total.sum(axis=1)) @ total)
