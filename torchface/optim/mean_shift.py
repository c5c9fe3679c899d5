"""Mean shift with a flat kernel: the modes of a set of weighted points."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import checked_number

_ROUNDS = 100


@dataclass(frozen=True, eq=False)
class Clusters:
    """Cluster centres (K,D), how much weight each holds (K,), and the cluster of each point (N,), largest first."""

    centres: Tensor
    sizes: Tensor
    labels: Tensor


def mean_shift(points: Tensor, bandwidth: float, weights: Tensor | None = None) -> Clusters:
    r"""Moves a seed to the mean of the points (N,D) within the bandwidth until it rests; seeds that meet are a cluster.

    Seeds are the bins of a grid of one bandwidth that hold a point. A centre closer than a bandwidth to one with more
    weight around it is dropped; a point belongs to the nearest centre.

    Args:
        weights: how often each point counts, (N,); once if absent.

    Source: Comaniciu and Meer 2002; the same rules as scikit-learn's ``MeanShift(bin_seeding=True)``.
    """
    if points.ndim != 2 or len(points) == 0:
        raise ShapeError(f"mean_shift: found points {tuple(points.shape)}, expected (N,D) with at least one")
    checked_number("mean_shift: bandwidth", bandwidth, above=True)
    positions = points.double()
    weight = torch.ones(len(points), dtype=torch.float64) if weights is None else weights.double()
    if weight.shape != (len(points),):
        raise ShapeError(f"mean_shift: found weights {tuple(weight.shape)}, expected ({len(points)},)")
    for name, numbers, least in (("points", positions, -torch.inf), ("weights", weight, 0.0)):
        if not bool((torch.isfinite(numbers) & (numbers >= least)).all()):
            raise ValueRangeError(f"mean_shift: {name} hold NaN, infinite or negative entries, expected numbers")
    seeds = (positions / bandwidth).round().unique(dim=0) * bandwidth
    moving = torch.arange(len(seeds))
    for _ in range(_ROUNDS):  # each round starts where the last one ended
        inside = (torch.cdist(seeds[moving], positions) <= bandwidth).double() * weight
        total = inside.sum(1, keepdim=True)
        shifted = torch.where(total > 0, inside @ positions / total.clamp(min=1e-12), seeds[moving])
        still = (shifted - seeds[moving]).norm(dim=1) < 1e-3 * bandwidth
        seeds[moving] = shifted
        moving = moving[~still]
        if len(moving) == 0:
            break
    density = ((torch.cdist(seeds, positions) <= bandwidth).double() * weight).sum(1)
    centres = _apart(seeds[density > 0], density[density > 0], bandwidth)
    labels = torch.cdist(positions, centres).argmin(1)
    sizes = torch.zeros(len(centres), dtype=torch.float64).index_add_(0, labels, weight)
    order = sizes.argsort(descending=True, stable=True)
    return Clusters(centres[order].to(points), sizes[order].to(points), order.argsort()[labels])


def _apart(seeds: Tensor, density: Tensor, bandwidth: float) -> Tensor:
    """Greedy, densest first: which seed stays depends on those that stayed before."""
    ordered = seeds[density.argsort(descending=True, stable=True)]
    near = torch.cdist(ordered, ordered) < bandwidth
    free = torch.ones(len(ordered), dtype=torch.bool)
    kept: list[int] = []
    while bool(free.any()):
        best = int(free.nonzero()[0, 0])
        kept.append(best)
        free &= ~near[best]
    return ordered[kept]
