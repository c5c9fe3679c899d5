"""A dense mesh with few of its own vertices left, and how what moves those moves all."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import edges
from torchface.geometry.meshes.surface_index import triangle_coordinates

_BEYOND = 0.6  # how far past a triangle's side its slope is followed, as a part of the triangle


@dataclass(frozen=True, eq=False)
class CoarseLevel:
    """A coarse mesh among the vertices of a dense one."""

    vertex_ids: Tensor  # rows of the dense mesh's vertices that are left, (C,) int64
    faces: Tensor  # triangles between them, rows of vertex_ids, (G,3) int64
    # The matrix (V,C) that carries values from the coarse vertices to the dense ones; rows sum to 1, and on a flat mesh
    # affine fields are carried exactly.
    prolongation: sparse.csr_array


def coarse_level(vertices: Tensor, faces: Tensor, count: int) -> CoarseLevel:
    """Thins a mesh out to about ``count`` vertices; one that has no more stays as it is.

    Vertices are chosen on a grid, every vertex goes to the one that is nearest along the edges, and three that meet in
    a triangle make a coarse triangle. Values are carried from the nearest coarse triangle at a vertex's own, linearly:
    what lies close by and hangs together elsewhere only, such as the other lip, does not take part.
    """
    points, faces = vertices.detach().double().cpu(), faces.cpu()
    if len(points) <= count:
        return CoarseLevel(torch.arange(len(points)), faces, sparse.eye_array(len(points), format="csr"))
    chosen = _on_grid(points.numpy(), count)
    owner = _nearest_along_edges(points, faces, chosen)
    triple = torch.from_numpy(owner)[faces]
    distinct = (triple[:, 0] != triple[:, 1]) & (triple[:, 1] != triple[:, 2]) & (triple[:, 2] != triple[:, 0])
    triple = triple[distinct]
    turn = triple.argmin(1)[:, None]
    ordered = triple.gather(1, (torch.arange(3) + turn) % 3)  # the smallest first, the sense of rotation kept
    key = torch.cat([ordered[:, :1], ordered[:, 1:].sort(1).values], dim=1)
    _, place = np.unique(key.numpy(), axis=0, return_index=True)
    coarse_faces = ordered[torch.from_numpy(place)]
    ids = torch.from_numpy(chosen)
    return CoarseLevel(ids, coarse_faces, _prolongation(points, points[ids], coarse_faces, torch.from_numpy(owner)))


def _on_grid(points: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """About ``count`` vertices, that nearest to its middle in every cube of a grid, whose size is found by halving."""
    low, extent = points.min(0), np.ptp(points, axis=0).max()
    smallest, largest = extent / 4096, extent
    for _ in range(24):
        size = np.sqrt(smallest * largest)
        cells = len(np.unique(_cells(points, low, size)))
        smallest, largest = (size, largest) if cells > count else (smallest, size)
    cell = _cells(points, low, largest)
    off_middle = np.square((points - low) / largest % 1 - 0.5).sum(1)
    order = np.lexsort((off_middle, cell))
    first = np.ones(len(order), dtype=bool)
    first[1:] = cell[order][1:] != cell[order][:-1]
    return np.sort(order[first])


def _cells(points: NDArray[np.float64], low: NDArray[np.float64], size: float) -> NDArray[np.int64]:
    x, y, z = ((points - low) / size).astype(np.int64).T
    return (x << 40) + (y << 20) + z


def _nearest_along_edges(points: Tensor, faces: Tensor, chosen: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which of the chosen vertices each vertex belongs to, (V,).

    A part of the mesh without any belongs to the vertex that is nearest in space; there no grid was fine enough.
    """
    ends = edges(faces)
    length = (points[ends[:, 0]] - points[ends[:, 1]]).norm(dim=1).clamp(min=1e-9).numpy()
    one, other = ends.T.numpy()
    graph = sparse.coo_array((length, (one, other)), shape=(len(points), len(points))).tocsr()
    distance, _, source = dijkstra(graph, directed=False, indices=chosen, min_only=True, return_predecessors=True)
    row = np.full(len(points) + 1, -1, dtype=np.int64)
    row[chosen] = np.arange(len(chosen))
    owner = np.where(np.isfinite(distance), row[np.where(source < 0, len(points), source)], -1)
    owner[chosen] = np.arange(len(chosen))
    lost = np.flatnonzero(owner < 0)
    if len(lost):
        owner[lost] = cKDTree(points[chosen].numpy()).query(points[lost].numpy())[1]
    return owner


def _prolongation(points: Tensor, coarse: Tensor, faces: Tensor, owner: Tensor) -> sparse.csr_array:
    """From the nearest of the triangles round each vertex's own coarse vertex; from that vertex where it has none."""
    corner = faces.flatten()
    order = corner.argsort(stable=True)
    degree = corner.bincount(minlength=len(coarse))
    start = degree.cumsum(0) - degree
    has_any = degree[owner] > 0
    vertex = has_any.nonzero()[:, 0]
    best = torch.full((len(points),), torch.inf, dtype=points.dtype)
    triangle = torch.zeros(len(points), dtype=torch.int64)
    for k in range(int(degree.max()) if len(faces) else 0):  # a triangle round each coarse vertex a turn: few
        some = vertex[degree[owner[vertex]] > k]
        tried = order[start[owner[some]] + k] // 3
        squared = _inside(points[some], coarse, faces[tried])[1]
        nearer = squared < best[some]
        best[some[nearer]], triangle[some[nearer]] = squared[nearer], tried[nearer]
    corners = torch.stack([owner] * 3, dim=1)
    weights = torch.zeros(len(points), 3, dtype=points.dtype)
    weights[:, 0] = 1
    corners[vertex] = faces[triangle[vertex]]
    clamped = _inside(points[vertex], coarse, corners[vertex])[0]
    free = _in_plane(points[vertex], coarse, corners[vertex])
    near = ((free > -_BEYOND) & (free < 1 + _BEYOND)).all(1, keepdim=True)
    weights[vertex] = torch.where(near, free, clamped)
    rows = np.arange(len(points)).repeat(3)
    shape = (len(points), len(coarse))
    return sparse.csr_array((weights.flatten().numpy(), (rows, corners.flatten().numpy())), shape=shape)


def _products(points: Tensor, coarse: Tensor, triangles: Tensor) -> tuple[Tensor, ...]:
    a, b, c = coarse[triangles].unbind(1)
    ab, ac, ap = b - a, c - a, points - a
    return ab, ac, ap, ab.square().sum(1), ac.square().sum(1), (ab * ac).sum(1), (ab * ap).sum(1), (ac * ap).sum(1)


def _inside(points: Tensor, coarse: Tensor, triangles: Tensor) -> tuple[Tensor, Tensor]:
    """Barycentric coordinates (N,3) of the nearest point of each one's triangle, and the squared distance."""
    ab, ac, ap, *products = _products(points, coarse, triangles)
    v, w = triangle_coordinates(*products)
    left = ap - v[:, None] * ab - w[:, None] * ac
    return torch.stack([1 - v - w, v, w], dim=1), left.square().sum(1)


def _in_plane(points: Tensor, coarse: Tensor, triangles: Tensor) -> Tensor:
    """Barycentric coordinates (N,3) in the plane of each one's triangle, beyond its sides too; NaN without area."""
    _, _, _, ab2, ac2, abac, d1, d2 = _products(points, coarse, triangles)
    determinant = ab2 * ac2 - abac * abac
    v, w = (ac2 * d1 - abac * d2) / determinant, (ab2 * d2 - abac * d1) / determinant
    return torch.stack([1 - v - w, v, w], dim=1)
