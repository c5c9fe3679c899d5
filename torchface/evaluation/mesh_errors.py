"""Errors of a solved performance against the true one at the markers and over the whole mesh."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import ShapeError
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.rig import BlendshapeRig


def marker_rmse(rig: BlendshapeRig, attachment: Attachment, weights: Tensor, markers: Tensor) -> Tensor:
    """Root mean square distance between seen markers (T,M,3) and the solved face, a frame, (T,), millimetres.

    NaN markers are left out; a frame without any is NaN. Source: thesis, figure 58.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> nose = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks[[30]])
        >>> seen = nose.on(rig.neutral.faces, rig.vertices) + torch.tensor([0.0, 2.0, 0.0])
        >>> marker_rmse(rig, nose, torch.zeros(1, len(rig.names)), seen[None]).round(decimals=3).tolist()
        [2.0]
    """
    return marker_offsets(rig, attachment, weights, markers).square().sum(-1).nanmean(-1).sqrt()


def marker_offsets(rig: BlendshapeRig, attachment: Attachment, weights: Tensor, markers: Tensor) -> Tensor:
    """From each marker's site on the rig at weights (T,N) to the marker (T,M,3): (T,M,3), NaN where it is NaN."""
    faces = rig.neutral.faces
    basis = attachment.on(faces, rig.deltas)
    sites = attachment.on(faces, rig.vertices) + torch.einsum("tn,nmc->tmc", weights.to(basis), basis)
    if rig.activation is not None and rig.corrective_deltas is not None:
        corrections = attachment.on(faces, rig.corrective_deltas)
        sites = sites + torch.einsum("tn,nmc->tmc", rig.activation(weights.to(corrections)), corrections)
    return markers.to(basis) - sites


def moved_vertices(rig: BlendshapeRig, weights: Tensor, keep: Tensor) -> Tensor:
    """Some vertices of a rig, ids or a mask, at weights (B,N): (B,K,3).

    Example:
        >>> rig = BlendshapeRig.from_tensors(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(1, 3, 3))
        >>> moved_vertices(rig, torch.tensor([[0.5]]), torch.tensor([2])).tolist()
        [[[0.5, 0.5, 1.5]]]
    """
    moved = weights @ rig.deltas[:, keep].flatten(1)
    if rig.activation is not None and rig.corrective_deltas is not None:
        moved = moved + rig.activation(weights) @ rig.corrective_deltas[:, keep].flatten(1)
    return rig.vertices[keep] + moved.unflatten(1, (-1, 3))


@dataclass(frozen=True, eq=False)
class MeshError:
    """Distances between two animated meshes of one topology, millimetres.

    Args:
        vertex_mean: over frames, a vertex, (V,).
        vertex_largest: over frames, a vertex, (V,).
        frame_mean: over vertices, a frame, (T,).
        motion_mean: how far the true face is from its neutral, mean over all; what the error is to be compared with.

    Example:
        >>> rig = BlendshapeRig.from_tensors(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(1, 3, 3))
        >>> error = mesh_error(rig, torch.tensor([[0.75]]), rig, torch.tensor([[1.0]]))
        >>> round(error.relative, 4)
        0.25
    """

    vertex_mean: Tensor
    vertex_largest: Tensor
    frame_mean: Tensor
    motion_mean: float

    @property
    def mean(self) -> float:
        """Over all frames and vertices."""
        return float(self.frame_mean.mean())

    @property
    def relative(self) -> float:
        """The mean error as a share of the mean motion."""
        return self.mean / max(self.motion_mean, 1e-12)


def mesh_error(
    solved_rig: BlendshapeRig,
    solved: Tensor,
    true_rig: BlendshapeRig,
    true: Tensor,
    vertices: Tensor | None = None,
    chunk: int = 64,
) -> MeshError:
    """Compares two rigs of one topology, each moved by its own weights (T,N).

    Args:
        solved_rig, solved: what came back.
        true_rig, true: what was.
        vertices: ids or a mask of the vertices that count; all if absent.
        chunk: frames at a time, so that memory stays bounded.

    Example:
        >>> rig = BlendshapeRig.from_tensors(torch.eye(3), torch.tensor([[0, 1, 2]]), 3.0 * torch.eye(3)[None])
        >>> round(mesh_error(rig, torch.tensor([[0.5]]), rig, torch.tensor([[1.0]])).mean, 4)
        1.5
    """
    if len(solved) != len(true) or solved_rig.vertices.shape != true_rig.vertices.shape:
        raise ShapeError(
            f"mesh_error: found {len(solved)} and {len(true)} frames of {len(solved_rig.vertices)} and "
            f"{len(true_rig.vertices)} vertices, expected the same"
        )
    keep = torch.arange(len(true_rig.vertices)) if vertices is None else vertices
    total, largest = (torch.zeros(len(true_rig.vertices[keep])) for _ in range(2))
    frame_mean, motion = [], 0.0
    for start in range(0, len(true), chunk):
        rows = slice(start, start + chunk)
        found, face = (
            moved_vertices(rig, weights[rows].to(rig.vertices), keep)
            for rig, weights in ((solved_rig, solved), (true_rig, true))
        )
        distance = (found - face).norm(dim=-1)
        total += distance.sum(0)
        largest = torch.maximum(largest, distance.amax(0))
        frame_mean.append(distance.mean(1))
        motion += float((face - true_rig.vertices[keep]).norm(dim=-1).mean(1).sum())
    return MeshError(total / len(true), largest, torch.cat(frame_mean), motion / len(true))


def vertex_errors(found: Tensor, true: Tensor) -> Tensor:
    """Distances (T,V) between vertices (T,V,3) and true vertices (T,V,3), millimetres; NaN where either has none.

    Raises:
        ShapeError: the shapes differ.

    Source: thesis 4.2.13.

    Example:
        >>> vertex_errors(torch.zeros(1, 2, 3), torch.tensor([[[0.0, 3.0, 4.0], [0.0, 0.0, 0.0]]])).tolist()
        [[5.0, 0.0]]
    """
    if found.shape != true.shape or found.ndim != 3 or found.shape[2] != 3:
        raise ShapeError(f"vertex_errors: found {tuple(found.shape)} and {tuple(true.shape)}, expected (T,V,3) twice")
    return (found - true.to(found)).norm(dim=-1)


@dataclass(frozen=True, eq=False)
class RigidAlignment:
    """Frames aligned with true ones.

    Args:
        vertices: the moved frames, (T,V,3).
        motion: what moved them, without a change of size, T of them.

    Example:
        >>> scan = torch.tensor([[[0.0, 0, 0], [9, 0, 0], [0, 5, 0], [0, 0, 2]]])
        >>> quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        >>> rigidly_aligned(scan @ quarter.T, scan).degrees.round(decimals=2).tolist()
        [90.0]
    """

    vertices: Tensor
    motion: Similarity

    @property
    def degrees(self) -> Tensor:
        """The angle by which each frame was rotated, (T,)."""
        trace = self.motion.rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
        return torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).acos())


def rigidly_aligned(found: Tensor, true: Tensor) -> RigidAlignment:
    """Each frame (T,V,3) rotated and translated, without scaling, to where it is nearest to the true one (T,V,3).

    A vertex that is NaN in either is ignored. Where the two share a space this hides errors of the pose; it is for
    scans and results whose spaces differ.

    Raises:
        ShapeError: the shapes differ, or a frame has fewer than three vertices.

    Example:
        >>> scan = torch.tensor([[[0.0, 0, 0], [9, 0, 0], [0, 5, 0], [0, 0, 2]]])
        >>> aligned = rigidly_aligned(scan + 40.0, scan)
        >>> bool(vertex_errors(aligned.vertices, scan).max() < 1e-4)
        True
    """
    motion = similarity_transform(found, true.to(found), scale=False)
    return RigidAlignment(motion.apply(found), motion)
