"""iBUG's 68 landmarks among the 478 points of MediaPipe's face mesh."""

import torch
from torch import Tensor

from torchface.errors import ShapeError

MESH_POINTS = 478  # points of the mesh: 468 of the face, and five on each iris behind them
FACE_POINTS = 468  # points of the mesh without the irises
IRISES = (468, 473)  # the irises' middles, the person's right eye first

BLENDSHAPE_POINTS = (
    0, 1, 4, 5, 6, 7, 8, 10, 13, 14, 17, 21, 33, 37, 39, 40, 46, 52, 53, 54, 55, 58, 61, 63, 65, 66, 67, 70, 78, 80,
    81, 82, 84, 87, 88, 91, 93, 95, 103, 105, 107, 109, 127, 132, 133, 136, 144, 145, 146, 148, 149, 150, 152, 153, 154,
    155, 157, 158, 159, 160, 161, 162, 163, 168, 172, 173, 176, 178, 181, 185, 191, 195, 197, 234, 246, 249, 251, 263,
    267, 269, 270, 276, 282, 283, 284, 285, 288, 291, 293, 295, 296, 297, 300, 308, 310, 311, 312, 314, 317, 318, 321,
    323, 324, 332, 334, 336, 338, 356, 361, 362, 365, 373, 374, 375, 377, 378, 379, 380, 381, 382, 384, 385, 386, 387,
    388, 389, 390, 397, 398, 400, 402, 405, 409, 415, 454, 466, 468, 469, 470, 471, 472, 473, 474, 475, 476, 477,
)  # fmt: skip
"""Points that the network of blendshapes takes, in its order."""

# The jaw's line along the mesh's oval, where iBUG's 17 lie evenly spaced; the mesh has fewer points there and on the
# bridge of the nose, so that some landmarks lie half-way between two.
_JAW = (127, 234, 93, (132, 58), (58, 172), 136, 150, 176, 152, 400, 379, 365, (397, 288), 361, 323, 454, 356)
_BROWS = (70, 63, 105, 66, 107, 336, 296, 334, 293, 300)
_NOSE = ((6, 168), (195, 197), 5, 4, 75, 97, 2, 326, 305)
_EYES = (33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380)
_LIPS = (61, 39, 37, 0, 267, 269, 291, 321, 314, 17, 84, 91, 78, 82, 13, 312, 308, 317, 14, 87)
_PAIRS = [one if isinstance(one, tuple) else (one, one) for one in (*_JAW, *_BROWS, *_NOSE, *_EYES, *_LIPS)]


def landmarks_of_mesh(points: Tensor) -> Tensor:
    """iBUG's 68 landmarks (...,68,D) of face meshes (...,478,D), or (...,468,D) without irises."""
    if points.ndim < 2 or points.shape[-2] not in (FACE_POINTS, MESH_POINTS):
        raise ShapeError(f"mesh points: found {tuple(points.shape)}, expected (...,{MESH_POINTS},D)")
    return points[..., torch.tensor(_PAIRS), :].mean(-2)
