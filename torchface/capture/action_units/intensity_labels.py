"""Intensity levels of the frames of an action, by clustering along the first principal component of their images."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError


def intensity_levels(images: Tensor, at_rest: Tensor, levels: int = 4, seed: int = 0) -> Tensor:
    """The level of each frame of one action, 0 for rest.

    The first principal component gives one number a frame; k-means clusters these into ``levels``, which are
    ordered by how far they lie from the frames at rest.

    Args:
        images: one region, or several side by side, in every repetition of the action, (T,...).
        at_rest: frames just before and after a repetition, (T,) bool.
        levels: k; the lowest is rest.
        seed: of k-means.

    Returns:
        (T,) int64 from 0 to ``levels - 1``.

    Raises:
        ShapeError: ``at_rest`` is not (T,), or no frame is at rest.
        ValueRangeError: fewer frames than levels, or frames that do not differ.

    Source: thesis 4.1.11.
    """
    if at_rest.shape != images.shape[:1] or not bool(at_rest.any()):
        raise ShapeError(f"at_rest: found {int(at_rest.sum())} of {tuple(at_rest.shape)}, expected (T,) with some")
    mode = main_mode(images)
    if len(mode.unique()) < levels:
        raise ValueRangeError(
            f"intensity levels: found {len(mode.unique())} different frames, expected at least {levels} to cluster"
        )
    from sklearn.cluster import KMeans  # takes a second, and only training needs it

    clusters = KMeans(levels, n_init=10, random_state=seed).fit(mode[:, None].numpy())
    centres = torch.from_numpy(clusters.cluster_centers_[:, 0]).double()
    order = (centres - mode[at_rest].median()).abs().argsort()
    rank = torch.empty_like(order)
    rank[order] = torch.arange(levels)
    return rank[torch.from_numpy(clusters.labels_).long()]


def main_mode(images: Tensor) -> Tensor:
    """Scores (T,) float64 of frames (T,...) along their first principal component."""
    samples = images.flatten(1).double()
    centred = samples - samples.mean(0)
    values, vectors = torch.linalg.eigh(centred @ centred.T)
    first = vectors[:, -1] * values[-1].clamp(min=0).sqrt()
    # The sign of an eigenvector is arbitrary: the same frames give the same scores.
    return first * torch.where(first[first.abs().argmax()] < 0, -1.0, 1.0)
