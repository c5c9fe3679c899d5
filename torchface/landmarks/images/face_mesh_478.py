"""iBUG's 68 landmarks among the 478 points of MediaPipe's face mesh."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import ShapeError

MESH_POINTS = 478
"""Points of the mesh: 468 of the face, and five on each iris behind them."""

FACE_POINTS = 468
"""Points of the mesh without the irises."""

# The jaw's line along the mesh's oval, where iBUG's 17 lie evenly spaced; the mesh has fewer points there and on the
# bridge of the nose, so that some landmarks lie half-way between two.
_JAW = (127, 234, 93, (132, 58), (58, 172), 136, 150, 176, 152, 400, 379, 365, (397, 288), 361, 323, 454, 356)
_BROWS = (70, 63, 105, 66, 107, 336, 296, 334, 293, 300)
_NOSE = ((6, 168), (195, 197), 5, 4, 75, 97, 2, 326, 305)
_EYES = (33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380)
_LIPS = (61, 39, 37, 0, 267, 269, 291, 321, 314, 17, 84, 91, 78, 82, 13, 312, 308, 317, 14, 87)
_PAIRS = [one if isinstance(one, tuple) else (one, one) for one in (*_JAW, *_BROWS, *_NOSE, *_EYES, *_LIPS)]


def landmarks_of_mesh(points: Tensor) -> Tensor:
    """iBUG's 68 landmarks of face meshes.

    Args:
        points: (...,478,D), or (...,468,D) without irises.

    Returns:
        (...,68,D).
    """
    if points.ndim < 2 or points.shape[-2] not in (FACE_POINTS, MESH_POINTS):
        raise ShapeError(f"mesh points: found {tuple(points.shape)}, expected (...,{MESH_POINTS},D)")
    return points[..., torch.tensor(_PAIRS), :].mean(-2)
