"""Pores and the fine relief of skin: small static heights that ride on it."""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.mesh import Mesh

_CELL, _LUMP_CELL = 1.5, 3.6  # millimetres
_FURROW, _PORE, _LUMP = 0.035, 0.06, 0.07  # millimetres deep or high
_FURROW_WIDTH, _PORE_RADIUS = 0.25, 0.45  # millimetres
_PORES = 0.35  # share of the cells with a pore
_JITTER = 1.0  # of a cell: how far its centre may lie from the middle, in all


def pore_heights(neutral: Mesh, seed: int) -> Tensor:
    """Heights over the smooth skin, millimetres, (V,): cells between furrows, some with a pore, and slow lumps.

    A function of the place alone, so the skin is the same for every density of a mesh: a denser one shows more of it.

    Source: Worley 1996, A Cellular Texture Basis Function.
    """
    places = neutral.vertices.double().numpy()
    cells = _cells(places, _CELL, seed)
    heights = -_FURROW * np.exp(-(cells.second - cells.nearest) / _FURROW_WIDTH)
    has_pore = cells.value > 1 - 2 * _PORES
    heights -= _PORE * has_pore * np.exp(-0.5 * (cells.nearest / _PORE_RADIUS) ** 2)
    heights += _LUMP * _cells(places, _LUMP_CELL, seed + 1).blend
    return torch.from_numpy(heights - heights.mean()).float()


@dataclass(frozen=True, eq=False)
class _Cells:
    """What surrounds each place (V,): distances to the two nearest centres, a number in [-1,1] of the nearest, and a
    smooth blend of the numbers of all that are near."""

    nearest: NDArray[np.float64]
    second: NDArray[np.float64]
    value: NDArray[np.float64]
    blend: NDArray[np.float64]


def _cells(places: NDArray[np.float64], size: float, seed: int) -> _Cells:
    count = len(places)
    nearest, second = np.full(count, np.inf), np.full(count, np.inf)
    value, total, weights = np.zeros(count), np.zeros(count), np.zeros(count)
    home = np.floor(places / size).astype(np.int64)
    for step in itertools.product((-1, 0, 1), repeat=3):  # 27 cells, each a batch over the vertices
        cell = home + np.array(step)
        random = _hashed(cell, seed)
        centre = (cell + 0.5 + 0.5 * _JITTER * random[:, :3]) * size
        distance = np.sqrt(np.square(places - centre).sum(1))
        closer = distance < nearest
        second = np.where(closer, nearest, np.minimum(second, distance))
        value = np.where(closer, random[:, 3], value)
        nearest = np.where(closer, distance, nearest)
        weight = np.exp(-0.5 * np.square(distance / (0.6 * size)))
        total += weight * random[:, 3]
        weights += weight
    return _Cells(nearest, second, value, total / weights)


def _hashed(cell: NDArray[np.int64], seed: int) -> NDArray[np.float64]:
    """Four numbers in [-1,1] for each cell (V,3) of an endless grid, (V,4). Source: Steele 2014, SplitMix."""
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    with np.errstate(over="ignore"):  # arithmetic modulo 2^64 is meant
        key = (cell.astype(np.uint64) * factors).sum(1, dtype=np.uint64) + np.uint64(seed) * factors[1]
        channel = np.arange(1, 5, dtype=np.uint64) * factors[0]
        bits = key[:, None] + channel
        bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        bits = bits ^ (bits >> np.uint64(31))
    return (bits >> np.uint64(11)).astype(np.float64) / 2**52 - 1
