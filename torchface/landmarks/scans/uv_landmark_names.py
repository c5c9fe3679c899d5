"""The twelve landmarks that are found in UV space, and how they follow from the 68 of iBUG."""

import torch
from torch import Tensor

from torchface.errors import ShapeError

UV_LANDMARK_NAMES = (
    "nose",
    "between_eyes",
    "right_eye_outer",
    "right_eye_inner",
    "left_eye_inner",
    "left_eye_outer",
    "right_cheek",
    "left_cheek",
    "right_mouth_corner",
    "left_mouth_corner",
    "mouth_top",
    "mouth_bottom",
)
"""In order; left and right are the performer's own, so ``right_`` lies on the image's left."""

MIRRORED = (0, 1, 5, 4, 3, 2, 7, 6, 9, 8, 10, 11)  # the landmark on the other side of the face

LINES = {
    "right_lids": ("right_eye_outer", "right_eye_inner"),
    "left_lids": ("left_eye_inner", "left_eye_outer"),
    "lips": ("right_mouth_corner", "left_mouth_corner"),
}
"""The traced lines and the landmarks at their ends, the one on the image's left first."""

IBUG_ROWS = {
    "nose": 30,
    "between_eyes": 27,
    "right_eye_outer": 36,
    "right_eye_inner": 39,
    "left_eye_inner": 42,
    "left_eye_outer": 45,
    "right_mouth_corner": 48,
    "left_mouth_corner": 54,
    "mouth_top": 51,
    "mouth_bottom": 57,
}
"""The rows of iBUG's 68 that ten of the twelve are; cheeks lie between others."""

_CHEEKS = {"right_cheek": (36, 48, 3), "left_cheek": (45, 54, 13)}


def uv_landmarks_from_ibug(points: Tensor) -> Tensor:
    """The twelve landmarks of 68-point sets.

    iBUG has no cheeks: a cheek is taken as the mean of the eye's outer corner, the mouth's corner and the jaw point
    below the ear, and lies under the skin until it is projected onto a surface.

    Args:
        points: (...,68,D) in iBUG's order.

    Returns:
        (...,12,D) in the order of ``UV_LANDMARK_NAMES``.

    Raises:
        ShapeError: not 68 points.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> points = uv_landmarks_from_ibug(head.vertices[head.landmarks])
        >>> torch.allclose(points[UV_LANDMARK_NAMES.index("nose")], head.vertices[head.landmarks[30]])
        True
    """
    if points.ndim < 2 or points.shape[-2] != 68:
        raise ShapeError(f"uv_landmarks_from_ibug: found {tuple(points.shape)}, expected (...,68,D)")
    rows = [
        points[..., IBUG_ROWS[name], :] if name in IBUG_ROWS else points[..., list(_CHEEKS[name]), :].mean(-2)
        for name in UV_LANDMARK_NAMES
    ]
    return torch.stack(rows, dim=-2)
