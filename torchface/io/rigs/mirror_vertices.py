"""Which vertex of a nearly symmetric head is the mirror image of which."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

_MAX_DISTANCE = 1.0
_MAX_UNMATCHED = 1000


def mirror_by_parts(vertices: Tensor, parts: dict[str, Tensor]) -> Tensor | None:
    """The mirror map (V,) of a head whose parts lie apart, left ones named ``..._left`` and right ones ``..._right``.

    Left and right parts go by the order of their vertices where that fits, else, as parts on the midline, by nearest
    place; vertices that lie on each other are matched one to one so that the map is its own inverse.

    Args:
        vertices: (V,3), millimetres, mirrored in x.
        parts: masks (V,) that together cover every vertex once.

    Returns:
        None where a vertex would be more than 1 mm from its image, or the map is not its own inverse.
    """
    points = vertices.double().numpy()
    flipped = points * [-1, 1, 1]
    twin = np.full(len(points), -1, np.int64)
    for name, mask in parts.items():
        other = name.removesuffix("_left") + "_right" if name.endswith("_left") else name
        if name.endswith("_right"):
            continue
        a, b = np.flatnonzero(mask.numpy()), np.flatnonzero(parts[other].numpy())
        image = _images(flipped[a], points[b])
        if image is None:
            return None
        twin[a], twin[b[image]] = b[image], a
    whole = bool((twin >= 0).all()) and np.array_equal(twin[twin], np.arange(len(twin)))
    if not whole or np.linalg.norm(flipped - points[twin], axis=1).max() > _MAX_DISTANCE:
        return None
    return torch.from_numpy(twin)


def _images(flipped: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """For each flipped point its place among ``points``, each taken once."""
    if len(flipped) != len(points):
        return None
    if np.linalg.norm(flipped - points, axis=1).max() <= _MAX_DISTANCE:
        return np.arange(len(points))
    forward, backward = cKDTree(points).query(flipped)[1], cKDTree(flipped).query(points)[1]
    mutual = backward[forward] == np.arange(len(points))
    left, right = np.flatnonzero(~mutual), np.setdiff1d(np.arange(len(points)), forward[mutual])
    if len(left) > _MAX_UNMATCHED:
        return None
    rows, columns = linear_sum_assignment(cdist(flipped[left], points[right]))
    forward[left[rows]] = right[columns]
    return forward
