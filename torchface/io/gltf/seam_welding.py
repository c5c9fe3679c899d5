"""Back from vertices split at seams to the vertices of the mesh as authored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchface.geometry.meshes.uv_seams import merge_equal_rows
from torchface.io.gltf.primitive_reading import Part

_STIR = np.uint64(0x9E3779B97F4A7C15)
_AT_ONCE = 2**18


@dataclass(frozen=True)
class Weld:
    """Which split vertices are one.

    Args:
        vertex_of: for each split vertex the vertex it belongs to, (C,).
        row_of: for each vertex the first split one, (V,).
        authored: the numbering is the one the mesh was written with, so annotations hold.
    """

    vertex_of: NDArray[np.int64]
    row_of: NDArray[np.int64]
    authored: bool


def weld(part: Part) -> Weld:
    """By the vertex ids in the file where they are consistent, else by equal position and equal deltas."""
    if part.vertex_ids is not None:
        welded = _by_id(part, part.vertex_ids)
        if welded is not None:
            return welded
    return _by_position(part)


def _by_id(part: Part, ids: NDArray[np.int64]) -> Weld | None:
    """None where an id is missing or its split vertices lie apart, as when another program has edited the mesh."""
    present, row_of = np.unique(ids, return_index=True)
    if len(present) == 0 or int(present[-1]) != len(present) - 1:
        return None
    same = np.array_equal(part.positions, part.positions[row_of[ids]])
    same = same and all(np.array_equal(delta, delta[row_of[ids]]) for delta in part.deltas)
    return Weld(ids, row_of, True) if same else None


def _by_position(part: Part) -> Weld:
    """Vertices numbered by first appearance; lips that touch at rest stay apart because they move differently."""
    vertex_of, row_of = merge_equal_rows(_keys(part.positions[None]) + _keys(part.deltas))
    return Weld(vertex_of, row_of, False)


def _keys(tables: NDArray[np.float32]) -> NDArray[np.int64]:
    """Two numbers (C,2) for the rows of all tables (N,C,3), equal where all these are.

    Each is a sum of the rows' words, stirred and times odd numbers drawn by chance: no file can aim at two rows that
    have the same two keys and differ, and by chance they do once in 2^100.
    """
    generator = np.random.default_rng()
    count = tables.shape[1]
    keys = np.zeros((count, 2), np.uint64)
    for some in np.array_split(tables, 1 + tables.size // _AT_ONCE):  # all at once take three times the memory
        flat = (some + np.float32(0)).transpose(1, 0, 2).reshape(count, -1)  # -0 equals 0
        words = flat.view(np.uint32).astype(np.uint64) * _STIR
        words ^= words >> np.uint64(32)
        odd = generator.integers(2**63, size=(words.shape[1], 2), dtype=np.uint64) * np.uint64(2) + np.uint64(1)
        keys += words @ odd
    return keys.view(np.int64)
