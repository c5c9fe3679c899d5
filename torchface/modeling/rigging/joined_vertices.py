"""A mesh whose vertices that a file has split at seams are one again, its connected parts, and its skin's shapes."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import border_vertices, vertex_normals

_SAME_PLACE = 0.05  # millimetres: halves of a face that someone has modelled apart do not meet exactly
_ALIKE = 0.2


@dataclass(frozen=True, eq=False)
class JoinedMesh:
    """A mesh whose vertices in one place are one, unless they face apart."""

    vertices: Tensor  # (J,3) float64
    faces: Tensor  # (F,3) of them
    of: Tensor  # the joined vertex of each of the mesh's, (V,)
    part: Tensor  # connected part of each, (J,)


@dataclass(frozen=True, eq=False)
class JoinedHead:
    """A head's joined mesh in the template's place, and its skin's deltas."""

    vertices: Tensor
    part: Tensor
    loose: Tensor
    deltas: Tensor


def joined_vertices(vertices: Tensor, faces: Tensor) -> JoinedMesh:
    """Joins the vertices (V,3) that a file has split at seams; lips that touch, and lashes on a lid, stay apart."""
    normals, seam = vertex_normals(vertices, faces), border_vertices(faces, len(vertices)).nonzero()[:, 0]
    near = cKDTree(vertices[seam].numpy()).query_pairs(_SAME_PLACE, output_type="ndarray")
    first, second = seam[torch.from_numpy(near)].T
    alike = (normals[first] * normals[second]).sum(-1) > _ALIKE
    pairs = torch.stack([first[alike], second[alike]])
    of = torch.from_numpy(connected_labels(pairs, len(vertices)))
    count = int(of.max()) + 1
    kept = torch.zeros(count, dtype=torch.int64)
    kept[of.flip(0)] = torch.arange(len(of)).flip(0)
    own = of[faces]
    along = torch.cat([own[:, [0, 1]], own[:, [1, 2]]]).T
    return JoinedMesh(vertices[kept], own, of, torch.from_numpy(connected_labels(along, count)))


def connected_labels(pairs: Tensor, count: int) -> np.ndarray:
    graph = sparse.coo_array((np.ones(pairs.shape[1]), (pairs[0].numpy(), pairs[1].numpy())), (count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)
