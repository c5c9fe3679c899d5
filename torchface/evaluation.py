"""How far a solved performance is from the true one: in weights, at the markers, over the whole mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping


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


def weight_jitter(weights: Tensor) -> float:
    """How much weights (T,N) tremble: the root mean square of their second differences, over that of white noise.

    White noise of deviation 0.01 has a jitter of 0.01; NaN for fewer than three frames.
    """
    if len(weights) < 3:
        return float("nan")
    return float(((weights[2:] - 2 * weights[1:-1] + weights[:-2]).double().square().mean() / 6).sqrt())


@dataclass(frozen=True, eq=False)
class ShapeErrors:
    """Weights by one set of names against weights by another.

    Args:
        names: shapes of the truth that the result has too, N of them.
        error: of each.
        missing: shapes of the truth that the result lacks.
        frames: how many were compared.
    """

    names: tuple[str, ...]
    error: WeightError
    missing: tuple[str, ...]
    frames: int


def shape_errors(found: Tensor, found_names: Sequence[str], true: Tensor, true_names: Sequence[str]) -> ShapeErrors:
    """Compares weights (T,N) with true weights (T,M) shape by shape, as :func:`torchface.shape_names.mapping` has it.

    Args:
        found, found_names: what came back; a frame with NaN is left out.
        true, true_names: what was.

    Raises:
        ShapeError: the frames differ in number.
        NameMismatchError: no name of the one means a shape of the other.
        ValueRangeError: there is no frame without NaN.
    """
    if len(found) != len(true):
        raise ShapeError(f"shape_errors: found {len(found)} and {len(true)} frames, expected as many")
    matrix = mapping(found_names, true_names)
    compared = matrix.any(1)
    if not compared.any():
        raise NameMismatchError(
            f"shape_errors: found {', '.join(found_names[:5])}, ...; expected some of {', '.join(true_names[:5])}, ..."
        )
    whole = torch.isfinite(found).all(1) & torch.isfinite(true).all(1)
    if not whole.any():
        raise ValueRangeError("shape_errors: found NaN in every frame, expected weights")
    error = weight_error(found[whole].float() @ matrix[compared].T, true[whole].float()[:, compared])
    names = [
        [name for name, has in zip(true_names, compared.tolist(), strict=True) if has is wanted]
        for wanted in (True, False)
    ]
    return ShapeErrors(tuple(names[0]), error, tuple(names[1]), int(whole.sum()))


def marker_rmse(rig: BlendshapeRig, attachment: Attachment, weights: Tensor, markers: Tensor) -> Tensor:
    """Root mean square distance between seen markers (T,M,3) and the solved face, a frame, (T,), millimetres.

    NaN markers are left out; a frame without any is NaN. Source: thesis, figure 58.
    """
    faces = rig.neutral.faces
    basis = attachment.on(faces, rig.deltas)
    solved = attachment.on(faces, rig.vertices) + torch.einsum("tn,nmc->tmc", weights.to(basis), basis)
    if rig.activation is not None and rig.corrective_deltas is not None:
        more = attachment.on(faces, rig.corrective_deltas)
        solved = solved + torch.einsum("tn,nmc->tmc", rig.activation(weights.to(more)), more)
    return (solved - markers.to(basis)).square().sum(-1).nanmean(-1).sqrt()


def moved_vertices(rig: BlendshapeRig, weights: Tensor, keep: Tensor) -> Tensor:
    """Some vertices of a rig, ids or a mask, at weights (B,N): (B,K,3)."""
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
    """
    if found.shape != true.shape or found.ndim != 3 or found.shape[2] != 3:
        raise ShapeError(f"vertex_errors: found {tuple(found.shape)} and {tuple(true.shape)}, expected (T,V,3) twice")
    return (found - true.to(found)).norm(dim=-1)


@dataclass(frozen=True, eq=False)
class RigidAlignment:
    """Frames laid on true ones.

    Args:
        vertices: the moved frames, (T,V,3).
        motion: what moved them, without a change of size, T of them.
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
    """
    motion = similarity_transform(found, true.to(found), scale=False)
    return RigidAlignment(motion.apply(found), motion)


@dataclass(frozen=True)
class ErrorFigures:
    """Distances over frames and vertices in a few numbers, millimetres.

    Args:
        mean, median, percentile_95, largest: over all vertices of all frames that were compared.
        total: sum over the vertices of a frame, mean over the frames; for a single frame what the thesis calls the
            total error.
        vertices: how many were compared in any frame.
    """

    mean: float
    median: float
    percentile_95: float
    largest: float
    total: float
    vertices: int


def error_figures(errors: Tensor) -> ErrorFigures:
    """The figures of distances (T,V); NaN was not compared.

    Raises:
        ValueRangeError: nothing was compared.

    Source: thesis 4.2.13.
    """
    present = torch.isfinite(errors)
    if not present.any():
        raise ValueRangeError("error_figures: found no distance that is a number, expected at least one")
    values = errors[present].double().numpy()
    median, high = np.quantile(values, (0.5, 0.95))
    totals = torch.where(present, errors, 0).double().sum(1)[present.any(1)]
    return ErrorFigures(
        float(values.mean()),
        float(median),
        float(high),
        float(values.max()),
        float(totals.mean()),
        int(present.any(0).sum()),
    )


def region_figures(errors: Tensor, regions: Mapping[str, Tensor]) -> dict[str, ErrorFigures]:
    """The figures of distances (T,V) in each region, a mask (V,) by name; one where nothing was compared is left out.

    Raises:
        ShapeError: a mask is not (V,).
    """
    for name, mask in regions.items():
        if mask.shape != errors.shape[1:] or mask.dtype != torch.bool:
            raise ShapeError(
                f"regions[{name!r}]: found {mask.dtype} {tuple(mask.shape)}, expected a mask of "
                f"{tuple(errors.shape[1:])}"
            )
    inside = {name: errors[:, mask] for name, mask in regions.items()}
    return {name: error_figures(part) for name, part in inside.items() if torch.isfinite(part).any()}
