"""Which affine maps a stage may choose from: all, those of a coarse graph, or translations on top of given ones."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

_WIDTH = 1.5


@dataclass(frozen=True, eq=False)
class Subspace:
    """The directions in which affine maps may change: :math:`X_0 + B y`.

    Args:
        basis: :math:`B`, (4V,N).
        stiffness: :math:`M \\otimes G`, (4E,4V).
    """

    basis: sparse.csr_array
    stiffness: sparse.csr_array

    @cached_property
    def positions(self) -> sparse.csr_array:
        """The rows of the basis that give positions, (V,N): D B."""
        return self.basis[3::4].tocsr()

    @cached_property
    def stiffness_rows(self) -> sparse.csr_array:
        """(M ⊗ G) B, (4E,N)."""
        return (self.stiffness @ self.basis).tocsr()

    @cached_property
    def stiffness_matrix(self) -> sparse.csc_array:
        """The stiffness term's matrix, (N,N)."""
        return (self.stiffness_rows.T @ self.stiffness_rows).tocsc()


def all_maps(stiffness: sparse.csr_array) -> Subspace:
    """An affine map a vertex."""
    return Subspace(sparse.eye_array(stiffness.shape[1], format="csr"), stiffness)


def translations(stiffness: sparse.csr_array) -> Subspace:
    """A translation a vertex on top of the maps so far."""
    count = stiffness.shape[1] // 4
    rows = 4 * np.arange(count) + 3
    basis = sparse.csr_array((np.ones(count), (rows, np.arange(count))), shape=(4 * count, count))
    return Subspace(basis, stiffness)


def graph(points: NDArray[np.float64], pairs: NDArray[np.int64], stiffness: sparse.csr_array, count: int) -> Subspace:
    r"""A coarse graph: nodes far from each other, and every vertex a blend of the nodes near it along the surface.

    .. math:: X_i = \sum_k w_{ik} X_k, \qquad w_{ik} \propto \big(1 - d_{ik}^2 / r^2\big)^2

    with d along edges, so that the upper lip does not follow the lower, and r 1.5 times the largest distance from a
    vertex to its node. The stiffness is the full mesh's, restricted to such blends.

    Args:
        points: vertices at rest, (V,3).
        pairs: edges that link all of them, (E,2).
        stiffness: :math:`M \otimes G`.
        count: how many nodes, at most V.

    Source: Sumner, Schmid, Pauly 2007 (blending of nodes); thesis 3.2.3.
    """
    nodes = _far_apart(points, min(count, len(points)))
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    lengths = np.maximum(lengths, 1e-9 * lengths.mean() + 1e-12)
    shape = (len(points), len(points))
    ways = sparse.csr_array((lengths, (pairs[:, 0], pairs[:, 1])), shape=shape)
    nearest = dijkstra(ways, directed=False, indices=nodes, min_only=True)
    radius = _WIDTH * max(float(nearest.max()), float(lengths.mean()))
    distance = dijkstra(ways, directed=False, indices=nodes, limit=radius)
    node, vertex = np.nonzero(np.isfinite(distance))
    weight = (1 - (distance[node, vertex] / radius) ** 2) ** 2 + 1e-12
    weight /= np.bincount(vertex, weight, len(points))[vertex]
    return Subspace(_blend(points, nodes, node, vertex, weight), stiffness)


def _blend(
    points: NDArray[np.float64],
    nodes: NDArray[np.int64],
    node: NDArray[np.int64],
    vertex: NDArray[np.int64],
    weight: NDArray[np.float64],
) -> sparse.csr_array:
    """A node's map about the node, (A, p), is about the vertex (A, p + A (v_i - v_k))."""
    offset = points[vertex] - points[nodes[node]]
    rows = [4 * vertex + k for k in range(4)] + [4 * vertex + 3] * 3
    columns = [4 * node + k for k in range(4)] + [4 * node + k for k in range(3)]
    values = [weight] * 4 + [weight * offset[:, k] for k in range(3)]
    triplets = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(triplets, shape=(4 * len(points), 4 * len(nodes)))


def _far_apart(points: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Farthest points in turn from the first on, (K,) ascending; the loop is the method."""
    chosen = np.zeros(count, dtype=np.int64)
    distance = np.full(len(points), np.inf)
    for i in range(1, count):
        distance = np.minimum(distance, np.square(points - points[chosen[i - 1]]).sum(1))
        chosen[i] = distance.argmax()
    return np.unique(chosen)
