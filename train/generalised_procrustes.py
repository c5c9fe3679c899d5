"""Alignment of many shapes in correspondence with their mean."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.sample_batches import Samples, blocks
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.progress import Progress, silent

from .sample_views import MovedSamples

_TOLERANCE = 1e-3
_MAX_ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class Procrustes:
    """Shapes on their mean."""

    poses: Similarity  # what moves each shape, a batch of M, float64
    mean: Tensor  # of the moved shapes, (V,3) float64
    iterations: int  # how many were made


def generalised_procrustes(
    shapes: Samples,
    scale: bool = False,
    initial_mean: Tensor | None = None,
    progress: Progress | None = None,
) -> Procrustes:
    r"""The rigid motions that lay shapes on their common mean.

    .. math:: \min_{R_m, t_m, \bar x} \sum_m \sum_v \lVert s_m R_m x_{mv} + t_m - \bar x_v \rVert^2

    Alternately shapes are aligned to the mean and the mean computed anew, until it moves by under a micrometre. With
    scales, the mean keeps the shapes' mean size, or all would shrink to nothing.

    Args:
        shapes: (M,V,3), millimetres; read in blocks.
        initial_mean: where the mean is to lie, (V,3); where the first shape lies if absent.

    Source: Gower 1975; thesis 3.2.4.
    """
    progress = progress or silent
    count, vertices, channels = shapes.shape
    if channels != 3 or count < 1:
        raise ShapeError(f"shapes: found {tuple(shapes.shape)}, expected (M,V,3)")
    if initial_mean is not None and initial_mean.shape != (vertices, 3):
        raise ShapeError(f"initial_mean: found {tuple(initial_mean.shape)}, expected ({vertices}, 3)")
    parts = list(blocks(shapes))
    mean = shapes.read(0, 1)[0].double() if initial_mean is None else initial_mean.double()
    size = 0.0
    iterations, moved = 0, float("inf")
    while iterations < _MAX_ITERATIONS and moved > _TOLERANCE:
        poses, total, sizes = [], torch.zeros_like(mean), 0.0
        for begin, end in parts:
            read = shapes.read(begin, end).double()
            if not bool(torch.isfinite(read).all()):
                bad = int((~torch.isfinite(read)).flatten(1).any(1).nonzero()[0, 0]) + begin
                raise ValueRangeError(f"shapes: number {bad} holds NaN or infinity; expected none")
            poses.append(similarity_transform(read, mean.expand_as(read), scale=scale))
            total += poses[-1].apply(read).sum(0)
            sizes += float(_size(read).sum())
        found = total / count
        if scale:
            size = size or sizes / count
            found = found * (size / float(_size(found[None])))
        # What the mean as a whole has drifted by is taken back: the frame is the initial mean's.
        found = similarity_transform(found[None], mean[None], scale=False).apply(found)[0]
        moved, mean, iterations = float((found - mean).norm(dim=1).mean()), found, iterations + 1
        progress("aligning the shapes", iterations)
    pose = Similarity(*(torch.cat(t) for t in zip(*((p.scale, p.rotation, p.translation) for p in poses), strict=True)))
    return Procrustes(pose, mean, iterations)


def aligned(shapes: Samples, found: Procrustes) -> MovedSamples:
    """The shapes as the motions lay them."""
    return MovedSamples(shapes, found.poses)


def _size(shapes: Tensor) -> Tensor:
    """Root mean square distance from the centre, (M,)."""
    return (shapes - shapes.mean(1, keepdim=True)).square().sum(2).mean(1).sqrt()
