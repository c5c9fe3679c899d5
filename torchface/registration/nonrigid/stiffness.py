"""The stiffness term of non-rigid ICP: how much the affine maps of neighbouring vertices differ."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import edges

_BRIDGES = 8


def linked_edges(vertices: Tensor, faces: Tensor) -> NDArray[np.int64]:
    """The mesh's edges, and bridges from each smaller part to what is nearest of the rest, (E,2).

    An eyeball or a tooth shares no vertex with the face; bridges make it follow the face's motion.
    """
    pairs = edges(faces).numpy()
    count = len(vertices)
    while True:  # each turn at least halves the number of parts
        graph = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        parts, label = connected_components(graph, directed=False)
        if parts == 1:
            return pairs
        pairs = np.unique(np.sort(np.vstack([pairs, _bridges(vertices.double().numpy(), label)]), axis=1), axis=0)


def _bridges(points: NDArray[np.float64], label: NDArray[np.int32]) -> NDArray[np.int64]:
    """From each part but the largest, its vertices nearest to the rest, each with its nearest there."""
    sizes = np.bincount(label)
    edges = []
    for part in np.flatnonzero(np.arange(len(sizes)) != sizes.argmax()):  # a part a turn: they are tens
        own, rest = np.flatnonzero(label == part), np.flatnonzero(label != part)
        distance, nearest = cKDTree(points[rest]).query(points[own])
        chosen = np.argsort(distance, kind="stable")[:_BRIDGES]
        edges.append(np.stack([own[chosen], rest[nearest[chosen]]], axis=1))
    return np.concatenate(edges)


def stiffness_rows(vertices: Tensor, faces: Tensor, gradient_length: float) -> sparse.csr_array:
    r"""The matrix :math:`M \otimes G`, (4E,4V), that turns affine maps into their differences along edges.

    .. math:: \lVert (M \otimes G) X \rVert^2 = \sum_{(i,j)} \Big(\frac{\bar\ell}{\ell_{ij}}\Big)^2
        \lVert G\,(X_i - X_j)|_{m_{ij}} \rVert_F^2, \qquad G = \mathrm{diag}(g,g,g,1)

    Each map is written about its own vertex, :math:`v \mapsto A_i (v - v_i) + p_i`, with rows
    :math:`X_i = (A_i^\top, p_i)`, so that ``D X`` is simply the positions :math:`p`. The translation part of a
    difference is where the two maps send the middle :math:`m_{ij}` of the edge, which makes the energy the same
    wherever the origin lies, and zero for every affine motion of the whole.

    Args:
        gradient_length: :math:`g`, millimetres.

    Source: Amberg, Romdhani, Vetter 2007, equations 3 and 10; thesis 3.2.3, equation 5.
    """
    pairs = linked_edges(vertices.detach().cpu(), faces.detach().cpu())
    points = vertices.detach().cpu().double().numpy()
    span = points[pairs[:, 1]] - points[pairs[:, 0]]
    length = np.linalg.norm(span, axis=1)
    length = np.maximum(length, 1e-3 * length.mean() + 1e-12)
    weight = length.mean() / length
    count, edge = len(pairs), np.arange(len(pairs))
    rows, columns, values = [], [], []
    for end, sign in ((0, -1.0), (1, 1.0)):
        first = 4 * pairs[:, end]
        for k in range(3):
            rows += [k * count + edge, 3 * count + edge]
            columns += [first + k, first + k]
            values += [sign * gradient_length * weight, -0.5 * weight * span[:, k]]
        rows.append(3 * count + edge)
        columns.append(first + 3)
        values.append(sign * weight)
    triplets = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(triplets, shape=(4 * count, 4 * len(points)))


def identity_maps(vertices: Tensor) -> NDArray[np.float64]:
    """The maps X (4V,3) that leave every vertex where it is."""
    maps = np.zeros((len(vertices), 4, 3))
    maps[:, :3] = np.eye(3)
    maps[:, 3] = vertices.detach().cpu().double().numpy()
    return maps.reshape(-1, 3)


def positions(maps: NDArray[np.float64]) -> Tensor:
    """Where the maps X (4V,3) send their vertices, (V,3) float64."""
    return torch.from_numpy(maps[3::4].copy())
