"""Vertices split where texture coordinates differ, as glTF, trimesh and GPUs want them, and merged again."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_MAX_SORTED_COLUMNS = 8


@dataclass(frozen=True)
class Split:
    """One row for each pair of vertex and texture coordinate that occurs, in the order of the coordinates."""

    vertex_of: NDArray[np.int64]  # the vertex of each, (C,); those that no face has come last
    uv_of: NDArray[np.int64] | None  # its row of the texture coordinates, (C,); none without them
    triangles: NDArray[np.int64]  # the mesh's, into these rows, (F,3)


def split_at_seams(
    vertex_count: int,
    faces: NDArray[np.int64],
    uv_faces: NDArray[np.int64] | None,
    mirrored: NDArray[np.bool_] | None = None,
) -> Split:
    """Vertices with one texture coordinate each; one with corners (F,3) on both sides of a mirrored texture gets two
    rows."""
    if uv_faces is None:
        return Split(np.arange(vertex_count), None, faces)
    keys = uv_faces * vertex_count + faces
    sided = keys * 2 if mirrored is None else keys * 2 + mirrored
    pairs, triangles = np.unique(sided, return_inverse=True)
    vertex_of, uv_of = pairs // 2 % vertex_count, pairs // 2 // vertex_count
    loose = np.setdiff1d(np.arange(vertex_count), vertex_of)
    vertex_of, uv_of = np.append(vertex_of, loose), np.append(uv_of, np.zeros_like(loose))
    return Split(vertex_of, uv_of, triangles.reshape(-1, 3))


def merge_equal_rows(rows: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (C,K) that are equal as one; -0 equals 0: the number of each value (C,), by first appearance, and its row
    (V,)."""
    rows = np.ascontiguousarray(rows + rows.dtype.type(0))  # so that -0 equals 0 bit by bit
    bits: NDArray[Any] = rows.view(np.int32).reshape(len(rows), -1)
    if bits.shape[1] > _MAX_SORTED_COLUMNS:
        wide = rows.view([("", np.void, rows.shape[1] * rows.itemsize)]).reshape(-1)
        bits = np.unique(wide, return_inverse=True)[1].reshape(-1, 1)
    order = np.lexsort(bits.T)  # equal rows in the order of their appearance
    is_first = np.ones(len(rows), bool)
    is_first[1:] = (bits[order[1:]] != bits[order[:-1]]).any(1)
    first = order[is_first]
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    value_of = np.empty(len(rows), np.int64)
    value_of[order] = rank[np.cumsum(is_first) - 1]
    return value_of, np.sort(first)
