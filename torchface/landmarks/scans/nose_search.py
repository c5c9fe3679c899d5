"""Where a nose may be on a scan of unknown pose: points that stand out, and which way they look."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.landmarks.scans.surface_sample import SurfaceSample

_NEAR, _FAR = 9.0, 26.0
_APART = 9.0


@dataclass(frozen=True, eq=False)
class NoseCandidates:
    """Points (K,3) on the surface, the way each looks (K,3), best first."""

    points: Tensor
    directions: Tensor


def protrusion(points: Tensor, normals: Tensor, queries: Tensor) -> tuple[Tensor, Tensor]:
    r"""How far each query stands out over its surroundings, and the mean normal near it.

    With the mean normal n of the surface within 9 mm of q, what is measured is the mean of
    :math:`n \cdot (q - p)` over the surface points p between 9 and 26 mm away: nearly 0 on a cheek, 3 mm on a ball of
    a head's size, 10 mm at a nose.

    Args:
        points, normals: the surface, (N,3).
        queries: (Q,3).

    Returns:
        Heights (Q,) in millimetres and unit directions (Q,3).
    """
    tree, looked = cKDTree(points.numpy()), cKDTree(queries.numpy())
    pairs = looked.sparse_distance_matrix(tree, _FAR, output_type="ndarray")
    row, column = torch.from_numpy(pairs["i"].astype("int64")), torch.from_numpy(pairs["j"].astype("int64"))
    near = torch.from_numpy(pairs["v"].copy()) < _NEAR
    total = torch.zeros_like(queries).index_add_(0, row[near], normals[column[near]])
    direction = torch.nn.functional.normalize(total, dim=-1, eps=1e-20)
    row, column = row[~near], column[~near]
    height = ((queries[row] - points[column]) * direction[row]).sum(-1)
    count = torch.zeros(len(queries), dtype=torch.float64).index_add_(0, row, torch.ones_like(height))
    mean = torch.zeros(len(queries), dtype=torch.float64).index_add_(0, row, height) / count.clamp(min=1)
    return mean, direction


def nose_candidates(surface: SurfaceSample, count: int = 40, queries: int = 3000) -> NoseCandidates:
    """The points of a scan that stand out most, no two close together; hair, ears and collars are among them.

    Args:
        surface: the scan's sample.
        count: how many.
        queries: how many of the sample's points are looked at.
    """
    thinned = slice(0, 4 * queries)
    looked = surface.points[:queries]
    height, direction = protrusion(surface.points[thinned], surface.normals[thinned], looked)
    order = height.argsort(descending=True)
    looked, direction = looked[order], direction[order]
    # Greedy: which points are left depends on those taken before.
    apart = torch.cdist(looked, looked) > _APART
    free = torch.ones(len(looked), dtype=torch.bool)
    taken: list[int] = []
    while len(taken) < count and bool(free.any()):
        best = int(free.nonzero()[0, 0])
        taken.append(best)
        free &= apart[best]
    return NoseCandidates(looked[taken], direction[taken])
