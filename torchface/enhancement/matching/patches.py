"""A mesh's triangles in connected patches, and means over them: a shape space a hundred times smaller."""

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchface.number_checks import LARGEST_SEED, checked_count

_RELAXATIONS = 2  # sizes then deviate by a third of their mean; as sown at random, by more than half

Ids = NDArray[np.int64]


def grow_patches(faces: Tensor, vertex_count: int, size: int = 100, seed: int = 0) -> Tensor:
    """Patches of about equally many vertices, grown from random triangles.

    All patches grow at once, a ring of triangles in each turn. Then they grow again from their innermost triangles,
    which evens their sizes out.

    Args:
        size: vertices a patch, about.

    Returns:
        The patch of each triangle, (F,) int64, numbered from 0 without gaps. Every patch is connected by edges, and
        every part of the mesh has one at least.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 4.2.
    """
    checked_count("size", size, 1)
    checked_count("seed", seed, 0, LARGEST_SEED)
    used = len(np.unique(faces.cpu().numpy()))
    pairs = neighbouring_triangles(faces).cpu().numpy()
    return torch.from_numpy(grow_groups(pairs, len(faces), size * len(faces) / used, seed)).to(faces.device)


def grow_groups(pairs: Ids, count: int, size: float, seed: int) -> Ids:
    """Connected groups of about ``size`` of ``count`` nodes, grown along the graph's edges (E,2): each node's, (N,)."""
    table = neighbour_table(pairs, count)
    groups = grow_labels(*_sown(pairs, count, size, seed), table)
    for _ in range(_RELAXATIONS):
        innermost = _innermost(groups, pairs, table)
        groups = grow_labels(innermost, np.arange(len(innermost)), table)
    return groups


def patch_means(values: Tensor, patches: Tensor, areas: Tensor) -> Tensor:
    """The means of triangles' values (B,F,C) over each patch, weighted by area, (B,P,C); plain ones without area."""
    count = int(patches.max()) + 1
    weights = areas.to(values) + torch.finfo(values.dtype).tiny ** 0.5
    weights = weights / weights.new_zeros(count).index_add(0, patches, weights)[patches]
    sums = values.new_zeros(len(values), count, values.shape[2])
    return sums.index_add(1, patches, values * weights[:, None])


def neighbouring_triangles(faces: Tensor) -> Tensor:
    """Pairs (E,2) of triangles that share an edge; of more than two at one edge, each with the next."""
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys, order = (ends.amin(1) * (faces.max() + 1) + ends.amax(1)).sort(stable=True)
    triangle = order % len(faces)
    shared = keys[1:] == keys[:-1]
    return torch.stack([triangle[:-1][shared], triangle[1:][shared]], dim=1)


def neighbour_table(pairs: Ids, count: int) -> Ids:
    """Each node's neighbours along the edges (E,2), (N,D), filled up with itself."""
    source, target = np.concatenate([pairs, pairs[:, ::-1]]).T
    order = source.argsort(kind="stable")
    source, target = source[order], target[order]
    degree = np.bincount(source, minlength=count)
    place = np.arange(len(source)) - (degree.cumsum() - degree)[source]
    table = np.repeat(np.arange(count)[:, None], max(1, degree.max()), axis=1)
    table[source, place] = target
    return table


def _sown(pairs: Ids, count: int, size: float, seed: int) -> tuple[Ids, Ids]:
    """Random nodes, one for so many of each connected part, at least one a part, and their numbers."""
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    part = connected_components(links, directed=False)[1]
    shuffled = np.random.default_rng(seed).permutation(count)
    shuffled = shuffled[part[shuffled].argsort(kind="stable")]
    sizes = np.bincount(part)
    wanted = np.maximum(1, np.rint(sizes / size)).astype(np.int64)
    place = np.arange(count) - np.repeat(sizes.cumsum() - sizes, sizes)
    seeds = shuffled[place < np.repeat(wanted, sizes)]
    return seeds, np.arange(len(seeds))


def grow_labels(seeds: Ids, labels: Ids, table: Ids) -> Ids:
    """Labels of some nodes, (S,) both, grown to all nodes: of each the label that reaches it in fewest steps, (N,).

    A node that none reaches gets -1.
    """
    grown = np.full(len(table), -1)
    grown[seeds] = labels
    for ring in _rings(seeds, grown < 0, table):
        grown[ring] = grown[table[ring]].max(1)  # of the neighbours that have one, any
    return grown


def _innermost(groups: Ids, pairs: Ids, table: Ids) -> Ids:
    """Of each group the node furthest from its border, (G,)."""
    border = np.unique(pairs[groups[pairs[:, 0]] != groups[pairs[:, 1]]])
    free = np.ones(len(groups), dtype=bool)
    free[border] = False
    depth = np.zeros(len(groups), dtype=np.int64)
    for turn, ring in enumerate(_rings(border, free, table), start=1):
        depth[ring] = turn
    order = np.lexsort((depth, groups))
    return order[np.bincount(groups).cumsum() - 1]


def _rings(front: Ids, free: NDArray[np.bool_], table: Ids) -> Iterator[Ids]:
    """The free nodes next to a front, then those next to them, until none is left."""
    while len(front):
        near = table[front].ravel()
        front = np.unique(near[free[near]])
        free[front] = False
        if len(front):
            yield front
