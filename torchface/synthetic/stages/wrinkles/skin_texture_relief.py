"""Pores and the fine relief of skin: small static heights that ride on it."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.mesh import Mesh

_CELL = 2.2  # square millimetres of skin to each cell of the relief
_FURROW, _PORE, _LUMP = 0.035, 0.06, 0.07  # millimetres
_PORE_RADIUS = 0.45


def pore_heights(neutral: Mesh, seed: int) -> Tensor:
    """Heights over the smooth skin, millimetres, (V,): cells between furrows, pores where furrows meet, slow lumps.

    The same skin for every density of a mesh: a denser one shows more of it.

    Args:
        neutral: a dense mesh.
        seed: of where the cells lie.
    """
    random = np.random.default_rng(seed)
    places = neutral.vertices.double().numpy()
    low, high = places.min(0), places.max(0)
    heights = np.zeros(len(places))
    for share, size, depth in ((1.0, 1.0, _FURROW), (6.0, 2.4, _LUMP)):
        # Seeds fill the box about the head; those near the skin cut it into cells as foam is cut by a plane.
        spacing = (_CELL * share) ** 0.5
        stops = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*stops, indexing="ij"), -1)
        seeds = grid.reshape(-1, 3)
        seeds = seeds + random.uniform(-0.5, 0.5, seeds.shape) * spacing
        distance, nearest = cKDTree(seeds).query(places, k=2)
        between = distance[:, 1] - distance[:, 0]
        own = random.uniform(-1, 1, len(seeds))[nearest[:, 0]]
        if size == 1.0:
            heights += -depth * np.exp(-between / 0.25)
            has_pore = own > 0.35
            heights += -_PORE * has_pore * np.exp(-0.5 * (distance[:, 0] / _PORE_RADIUS) ** 2)
        else:
            weight = np.exp(-0.5 * (distance / spacing) ** 2)
            value = random.uniform(-1, 1, len(seeds))[nearest]
            heights += depth * (weight * value).sum(1) / weight.sum(1)
    return torch.from_numpy(heights - heights.mean()).float()
