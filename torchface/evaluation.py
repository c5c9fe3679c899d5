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

__all__ = [
    "ErrorFigures",
    "MeshError",
    "RigidAlignment",
    "ShapeErrors",
    "WeightError",
    "error_figures",
    "marker_rmse",
    "mesh_error",
    "moved_vertices",
    "region_figures",
    "rigidly_aligned",
    "shape_errors",
    "vertex_errors",
    "weight_error",
    "weight_jitter",
]


@dataclass(frozen=True, eq=False)
class WeightError:
    """Solved against true weights.

    Args:
        mean: mean absolute error over frames, a shape, (N,).
        largest: largest absolute error over frames, a shape, (N,).
        correlation: Pearson's, a shape, (N,); NaN for a shape that is constant in either.

    Example:
        >>> error = weight_error(torch.tensor([[0.25], [0.5]]), torch.tensor([[0.25], [1.0]]))
        >>> error.mean.item(), error.largest.item()
        (0.25, 0.5)
    """

    mean: Tensor
    largest: Tensor
    correlation: Tensor


def weight_error(solved: Tensor, true: Tensor) -> WeightError:
    """Compares weights (T,N) with weights (T,N).

    Example:
        >>> true = torch.tensor([[0.0], [0.5], [1.0]])
        >>> weight_error(0.5 * true, true).correlation.round(decimals=4).tolist()
        [1.0]
    """
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

    Example:
        >>> ramp = torch.linspace(0, 1, 65)[:, None]
        >>> weight_jitter(ramp)
        0.0
        >>> 0.009 < weight_jitter(0.01 * torch.randn(9999, 1, generator=torch.Generator().manual_seed(0))) < 0.011
        True
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

    Example:
        >>> curves = torch.linspace(0, 1, 5)[:, None]
        >>> compared = shape_errors(curves, ["jawOpen"], curves.repeat(1, 2), ["jawOpen", "tongueOut"])
        >>> compared.names, compared.missing, compared.frames
        (('jawOpen',), ('tongueOut',), 5)
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

    Example:
        >>> curves = torch.linspace(0, 1, 5)[:, None]
        >>> shape_errors(curves, ["eyeBlink_L"], curves, ["eyeBlinkLeft"]).error.mean.tolist()
        [0.0]
    """
    if len(found) != len(true):
        raise ShapeError(f"shape_errors: found {len(found)} and {len(true)} frames, expected as many")
    matrix = mapping(found_names, true_names).float()
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

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> nose = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks[[30]])
        >>> seen = nose.on(rig.neutral.faces, rig.vertices) + torch.tensor([0.0, 2.0, 0.0])
        >>> marker_rmse(rig, nose, torch.zeros(1, len(rig.names)), seen[None]).round(decimals=3).tolist()
        [2.0]
    """
    faces = rig.neutral.faces
    basis = attachment.on(faces, rig.deltas)
    solved = attachment.on(faces, rig.vertices) + torch.einsum("tn,nmc->tmc", weights.to(basis), basis)
    if rig.activation is not None and rig.corrective_deltas is not None:
        more = attachment.on(faces, rig.corrective_deltas)
        solved = solved + torch.einsum("tn,nmc->tmc", rig.activation(weights.to(more)), more)
    return (solved - markers.to(basis)).square().sum(-1).nanmean(-1).sqrt()


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
    """Frames laid on true ones.

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
        >>> laid = rigidly_aligned(scan + 40.0, scan)
        >>> bool(vertex_errors(laid.vertices, scan).max() < 1e-4)
        True
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

    Example:
        >>> figures = error_figures(torch.tensor([[1.0, 2.0, 6.0]]))
        >>> figures.mean, figures.median, figures.largest, figures.total
        (3.0, 2.0, 6.0, 9.0)
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

    Example:
        >>> error_figures(torch.tensor([[1.0, torch.nan, 3.0]])).mean
        2.0
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

    Example:
        >>> chin, lips = torch.tensor([True, False, False]), torch.tensor([False, True, True])
        >>> figures = region_figures(torch.tensor([[1.0, 2.0, 4.0]]), {"chin": chin, "lips": lips})
        >>> {name: one.mean for name, one in figures.items()}
        {'chin': 1.0, 'lips': 3.0}
    """
    for name, mask in regions.items():
        if mask.shape != errors.shape[1:] or mask.dtype != torch.bool:
            raise ShapeError(
                f"regions[{name!r}]: found {mask.dtype} {tuple(mask.shape)}, expected a mask of "
                f"{tuple(errors.shape[1:])}"
            )
    inside = {name: errors[:, mask] for name, mask in regions.items()}
    return {name: error_figures(part) for name, part in inside.items() if torch.isfinite(part).any()}
