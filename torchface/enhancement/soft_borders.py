"""Regions whose influence fades with the distance along the surface."""

from __future__ import annotations

import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from torchface.geometry.meshes.operators import edges

_LIMIT = 4.0  # standard deviations, where 0.0003 of the weight is left: half precision holds it


def surface_distances(vertices: Tensor, faces: Tensor, sources: Tensor, limit: float = float("inf")) -> Tensor:
    """The length of the shortest way along edges from the nearest source to each vertex, (V,), millimetres.

    Args:
        vertices: (V,3), millimetres.
        faces: (F,3) int64.
        sources: ids (S,) int64.
        limit: what is further away gets infinity.
    """
    pairs = edges(faces)
    lengths = (vertices[pairs[:, 0]] - vertices[pairs[:, 1]]).norm(dim=1).double().clamp(min=1e-9)
    ways = coo_array((lengths.cpu().numpy(), pairs.T.cpu().numpy()), shape=(len(vertices),) * 2).tocsr()
    distance = dijkstra(ways, directed=False, indices=sources.cpu().numpy(), min_only=True, limit=limit)
    return torch.from_numpy(distance).to(vertices)


def soft_weights(labels: Tensor, count: int, vertices: Tensor, faces: Tensor, sigma: float) -> Tensor:
    r"""The weight of each region at each triangle, (R,F) half: 1 inside, outside a Gaussian of the distance.

    .. math:: \omega_{r,t} = \exp(-d_{r,t}^2 / 2\sigma^2)

    Args:
        labels: the region of each triangle, (F,) int64.
        count: of regions, R.
        vertices: (V,3), millimetres.
        faces: (F,3) int64.
        sigma: millimetres.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 5.3.
    """
    weights = torch.zeros(count, len(faces), dtype=torch.float16)
    corner_label = labels[:, None].expand(-1, 3)
    low = torch.full((len(vertices),), count).scatter_reduce(0, faces.flatten(), corner_label.flatten(), "amin")
    high = torch.full((len(vertices),), -1).scatter_reduce(0, faces.flatten(), corner_label.flatten(), "amax")
    on_border = low != high
    for region in range(count):  # one after the other: the distances of all would be large
        inside = labels == region
        corners = faces[inside].unique()
        sources = corners[on_border[corners]]
        if len(sources):
            distance = surface_distances(vertices, faces, sources, _LIMIT * sigma)
            distance[corners] = 0.0
            distance = distance[faces].mean(1)
            weights[region] = torch.exp(-0.5 * (distance / sigma).square()).half()
        weights[region, inside] = 1.0
    return weights
