"""Affine maps that a stage chooses from: all, those of a coarse graph, or translations on top of given ones."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

_WIDTH = 1.5
_NEAREST = 6


@dataclass(frozen=True, eq=False)
class Subspace:
    """The directions in which affine maps may change: :math:`X_0 + B y`."""

    basis: sparse.csr_array  # B, (4V,N)
    stiffness: sparse.csr_array  # M \\otimes G, (4E,4V)

    @cached_property
    def positions(self) -> sparse.csr_array:
        """The rows of the basis that give positions, (V,N): D B."""
        return self.basis[3::4].tocsr()

    @cached_property
    def stiffness_matrix(self) -> sparse.csc_array:
        """The stiffness term's matrix, (N,N)."""
        # Squared first: (M ⊗ G) B has many more entries than B.
        return (self.basis.T @ ((self.stiffness.T @ self.stiffness) @ self.basis)).tocsc()

    def stiffness_gradient(self, maps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Half the stiffness term's derivative by y at the maps X (4V,3): (N,3)."""
        return self.basis.T @ (self.stiffness.T @ (self.stiffness @ maps))


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

    .. math:: X_i = \sum_k w_{ik} X_k, \qquad w_{ik} \propto \big(1 - d_{ik} / r_i\big)^2

    with d along edges, so that the upper lip does not follow the lower, and r the distance of the first node that is
    left out, the seventh. The stiffness is the full mesh's, restricted to such blends.

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
    node, vertex, weight = _nearest_nodes(distance, radius)
    return Subspace(_blend(points, nodes, node, vertex, weight), stiffness)


def _nearest_nodes(
    distance: NDArray[np.float64], radius: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Node, vertex and weight of each pair that counts, from distances (K,V), infinite beyond the radius."""
    count = min(_NEAREST + 1, len(distance))
    order = np.argpartition(distance, count - 1, axis=0)[:count]
    near = np.take_along_axis(distance, order, axis=0)
    reach = np.minimum(near.max(0), radius) if len(distance) > _NEAREST else np.full(distance.shape[1], radius)
    weight = np.square(np.maximum(1 - near / np.maximum(reach, 1e-300), 0.0)) * np.isfinite(near)
    # Nodes at equal distance all around leave no weight: then the nearest has it all.
    lone = weight.sum(0) < 1e-12
    weight[near[:, lone].argmin(0), np.flatnonzero(lone)] = 1.0
    weight /= weight.sum(0)
    row, vertex = np.nonzero(weight)
    return order[row, vertex], vertex, weight[row, vertex]


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
