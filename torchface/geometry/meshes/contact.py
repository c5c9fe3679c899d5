"""Contacts of a surface with itself in a pose: lids that close, lips that touch."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import components, edges, vertex_normals


@dataclass(frozen=True, eq=False)
class ContactPairs:
    """Vertices that face each other across a gap."""

    pairs: Tensor  # (K,2) int64
    closeness: Tensor  # (K,), from 1 where they touch to 0 at the finder's reach


class ContactFinder:
    """Finds the vertices of a surface that meet in a given pose.

    Two vertices meet when they are within reach, their normals oppose and no short path of edges joins them. Only
    vertices of one connected part meet: what else lies close, such as teeth in gums, is attached and not in contact.
    Where contacts are named, partners are sought among those: one from the first column, one from the second,
    whichever lie opposite each other in the pose.
    """

    def __init__(self, faces: Tensor, count: int, contacts: Tensor | None = None) -> None:
        self._faces = faces.cpu()
        self._named = contacts is not None and len(contacts) > 0
        self._first, self._second = np.full((2, count), not self._named)
        if contacts is not None and self._named:
            ends = contacts.cpu().numpy()
            self._first[ends[:, 0]], self._second[ends[:, 1]] = True, True
        self._pool = np.flatnonzero(self._first | self._second)
        self._part = components(self._faces, count).numpy()
        joined = edges(self._faces).numpy()
        link = sparse.coo_array((np.ones(len(joined), dtype=np.int32), (joined[:, 0], joined[:, 1])), (count, count))
        ring = (link + link.T + sparse.eye_array(count, dtype=np.int32)).tocsr()
        self._rings = {1: ring, 2: (ring @ ring).astype(bool).astype(np.int32)}

    def find(
        self, vertices: Tensor, reach: float, moving: Tensor | None = None, rings: int = 2, nearest: bool = True
    ) -> ContactPairs:
        """The pairs in contact in a pose.

        Args:
            reach: how far apart vertices in contact may be, millimetres.
            moving: mask (V,); pairs of which neither end moves are left out.
            rings: 1 or 2; vertices that a path of 2 or 4 edges joins do not meet.
            nearest: keep of each vertex's partners only the nearest, and those whose nearest partner it is.
        """
        vertices = vertices.detach().double().cpu()
        points, pool = vertices.numpy(), self._pool
        moved = np.ones(len(points), dtype=bool) if moving is None else moving.cpu().numpy()
        if not moved[pool].any():
            return _pairs(np.zeros((0, 2), dtype=np.int64), np.zeros(0))
        near = points[pool[moved[pool]]]
        inside = (points[pool] >= near.min(0) - reach) & (points[pool] <= near.max(0) + reach)
        pool = pool[inside.all(1)]
        places = points[pool]
        if not self._named:  # a fourth coordinate holds the parts apart, of which only vertices of one meet
            pool = pool[np.isin(self._part[pool], np.unique(self._part[moved]))]
            places = np.column_stack([points[pool], 2 * reach * self._part[pool]])
        tree = cKDTree(places, balanced_tree=False, compact_nodes=False)
        i, j = pool[tree.query_pairs(reach, output_type="ndarray")].T
        keep = moved[i] | moved[j]
        i, j = i[keep], j[keep]
        if self._named:
            swap = ~(self._first[i] & self._second[j])
            i, j = np.where(swap, j, i), np.where(swap, i, j)
            keep = self._first[i] & self._second[j]
        else:
            considered = torch.zeros(len(points), dtype=torch.bool)
            considered[pool] = True
            around = self._faces[considered[self._faces].any(1)]
            normals = vertex_normals(vertices, around).numpy()
            keep = np.einsum("kc,kc->k", normals[i], normals[j]) < 0
        i, j = i[keep], j[keep]
        if not self._named and len(i):
            ring = self._rings[rings]
            apart = np.asarray(ring[i].multiply(ring[j]).sum(1)).ravel() == 0
            i, j = i[apart], j[apart]
        distance = np.linalg.norm(points[i] - points[j], axis=1)
        chosen = _nearest_partner(i, distance) | _nearest_partner(j, distance) if nearest else slice(None)
        return _pairs(np.stack([i[chosen], j[chosen]], axis=1), np.square(1 - np.square(distance[chosen] / reach)))


def _pairs(pairs: np.ndarray, closeness: np.ndarray) -> ContactPairs:
    return ContactPairs(torch.from_numpy(pairs), torch.from_numpy(closeness))


def _nearest_partner(vertex: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Mask of the pairs that are the shortest of those that share ``vertex``."""
    order = np.lexsort((distance, vertex))
    first = np.ones(len(order), dtype=bool)
    first[1:] = vertex[order][1:] != vertex[order][:-1]
    mask = np.zeros(len(order), dtype=bool)
    mask[order[first]] = True
    return mask
