"""Operators of a triangle mesh: normals, areas, edges, borders, parts. All functions are batched."""

import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor


def corners(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The three corner positions (...,F,3) of each triangle."""
    a, b, c = (vertices.index_select(-2, corner) for corner in faces.unbind(-1))  # a third of the time of brackets
    return a, b, c


def triangle_cross(vertices: Tensor, faces: Tensor) -> Tensor:
    """Edge cross products (...,F,3): along the normal, twice the area long."""
    a, b, c = corners(vertices, faces)
    return torch.linalg.cross(b - a, c - a)


def triangle_areas(vertices: Tensor, faces: Tensor) -> Tensor:
    """Areas (...,F), square millimetres."""
    return 0.5 * triangle_cross(vertices, faces).norm(dim=-1)


def vertex_areas(vertices: Tensor, faces: Tensor) -> Tensor:
    """A third of the triangles around each vertex, (V,), square millimetres."""
    third = triangle_areas(vertices, faces).repeat_interleave(3) / 3
    return third.new_zeros(len(vertices)).index_add_(0, faces.flatten(), third)


def triangle_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (...,F,3); zero for a triangle without area."""
    return torch.nn.functional.normalize(triangle_cross(vertices, faces), dim=-1, eps=1e-20)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (...,V,3), the area-weighted mean of the triangles around; zero for a loose vertex."""
    cross = triangle_cross(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total.index_add_(-2, faces[:, corner], cross)
    return torch.nn.functional.normalize(total, dim=-1, eps=1e-20)


def edges(faces: Tensor) -> Tensor:
    """Every edge once, (E,2), smaller vertex id first, sorted."""
    if len(faces) == 0:
        return faces[:, :2]
    # One number a pair: sorting those is ten times faster than sorting rows.
    low, high = _ordered(faces, faces.roll(-1, 1))
    span = high.max() + 1
    keys = (low * span + high).unique()
    return torch.stack([keys // span, keys % span], dim=1)


def _ordered(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Ends of edges, the smaller vertex id first; ``amin`` over pairs of whole numbers takes fifty times as long."""
    return torch.minimum(first, second), torch.maximum(first, second)


def border_edges(faces: Tensor) -> Tensor:
    """Mask (F,3): whether the edge opposite each corner belongs to no other triangle."""
    if len(faces) == 0:
        return torch.zeros_like(faces, dtype=torch.bool)
    low, high = _ordered(faces.roll(-1, 1), faces.roll(-2, 1))
    keys = low * (faces.max() + 1) + high
    _, place, count = keys.unique(return_inverse=True, return_counts=True)
    return count[place] == 1


def border_vertices(faces: Tensor, vertex_count: int) -> Tensor:
    """Mask (V,) of the vertices on an edge that only one triangle has."""
    on_border = border_edges(faces)
    mask = torch.zeros(vertex_count, dtype=torch.bool, device=faces.device)
    for corner in range(3):
        mask[faces[:, [corner - 2, corner - 1]][on_border[:, corner]].flatten()] = True
    return mask


def components(faces: Tensor, vertex_count: int) -> Tensor:
    """The connected part each vertex belongs to, (V,) int64, numbered from 0 in order of first vertex."""
    pairs = edges(faces).cpu().numpy()
    graph = coo_matrix((torch.ones(len(pairs)).numpy(), (pairs[:, 0], pairs[:, 1])), shape=(vertex_count,) * 2)
    _, labels = connected_components(graph, directed=False)
    return torch.from_numpy(labels.astype("int64")).to(faces.device)
