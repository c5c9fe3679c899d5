"""How far a solved performance is from the true one: in weights, at the markers, over the whole mesh."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import ShapeError
from torchface.rig import BlendshapeRig


@dataclass(frozen=True, eq=False)
class WeightError:
    """Solved against true weights.

    Args:
        mean: mean absolute error over frames, a shape, (N,).
        largest: largest absolute error over frames, a shape, (N,).
        correlation: Pearson's, a shape, (N,); NaN for a shape that is constant in either.
    """

    mean: Tensor
    largest: Tensor
    correlation: Tensor


def weight_error(solved: Tensor, true: Tensor) -> WeightError:
    """Compares weights (T,N) with weights (T,N)."""
    if solved.shape != true.shape or solved.ndim != 2:
        raise ShapeError(f"weight_error: found {tuple(solved.shape)} and {tuple(true.shape)}, expected (T,N) twice")
    difference = (solved - true).abs()
    a, b = solved.double() - solved.double().mean(0), true.double() - true.double().mean(0)
    scale = a.norm(dim=0) * b.norm(dim=0)
    correlation = torch.where(scale > 1e-9, (a * b).sum(0) / scale.clamp(min=1e-12), torch.nan)
    return WeightError(difference.mean(0), difference.amax(0), correlation.to(solved.dtype))


def marker_rmse(rig: BlendshapeRig, attachment: Attachment, weights: Tensor, markers: Tensor) -> Tensor:
    """Root mean square distance between seen markers (T,M,3) and the solved face, a frame, (T,), millimetres.

    NaN markers are left out; a frame without any is NaN. Source: thesis, figure 58.
    """
    faces = rig.neutral.faces
    basis = attachment.on(faces, rig.deltas)
    solved = attachment.on(faces, rig.vertices) + torch.einsum("tn,nmc->tmc", weights.to(basis), basis)
    return (solved - markers.to(basis)).square().sum(-1).nanmean(-1).sqrt()


@dataclass(frozen=True, eq=False)
class MeshError:
    """Distances between two animated meshes of one topology, millimetres.

    Args:
        vertex_mean: over frames, a vertex, (V,).
        vertex_largest: over frames, a vertex, (V,).
        frame_mean: over vertices, a frame, (T,).
        motion_mean: how far the true face is from its neutral, mean over all; what the error is to be compared with.
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
    """
    if len(solved) != len(true) or solved_rig.vertices.shape != true_rig.vertices.shape:
        raise ShapeError(
            f"mesh_error: found {len(solved)} and {len(true)} frames of {len(solved_rig.vertices)} and "
            f"{len(true_rig.vertices)} vertices, expected the same"
        )
    keep = torch.arange(len(true_rig.vertices)) if vertices is None else vertices
    solved_neutral, true_neutral = solved_rig.vertices[keep], true_rig.vertices[keep]
    solved_deltas, true_deltas = solved_rig.deltas[:, keep].flatten(1), true_rig.deltas[:, keep].flatten(1)
    total = torch.zeros(len(true_neutral))
    largest = torch.zeros(len(true_neutral))
    frame_mean, motion = [], 0.0
    for start in range(0, len(true), chunk):
        rows = slice(start, start + chunk)
        moved = (true[rows].to(true_deltas) @ true_deltas).unflatten(1, (-1, 3))
        found = (solved[rows].to(solved_deltas) @ solved_deltas).unflatten(1, (-1, 3))
        distance = (found + solved_neutral - moved - true_neutral).norm(dim=-1)
        total += distance.sum(0)
        largest = torch.maximum(largest, distance.amax(0))
        frame_mean.append(distance.mean(1))
        motion += float(moved.norm(dim=-1).mean(1).sum())
    return MeshError(total / len(true), largest, torch.cat(frame_mean), motion / len(true))
