"""Rotations from their axis and angle, and the way back, or from quaternions."""

import torch
from torch import Tensor


def cross_matrix(vectors: Tensor) -> Tensor:
    """The matrices (...,3,3) that multiply as the cross product with vectors (...,3) does."""
    x, y, z = vectors.unbind(-1)
    none = torch.zeros_like(x)
    return torch.stack([none, -z, y, z, none, -x, -y, x, none], dim=-1).unflatten(-1, (3, 3))


def rotation_matrix(vectors: Tensor) -> Tensor:
    r"""The rotations (...,3,3) about the axes of vectors (...,3) by their lengths, in radians.

    .. math:: R = I + \frac{\sin\theta}{\theta} [v] + \frac{1 - \cos\theta}{\theta^2} [v]^2
    """
    # sinc divides without a case of its own for no angle; 2 sin²(θ/2)/θ² keeps the digits that 1 - cos θ loses.
    angle = vectors.norm(dim=-1)[..., None, None] / torch.pi
    cross = cross_matrix(vectors)
    turned = torch.sinc(angle) * cross + 0.5 * torch.sinc(0.5 * angle).square() * (cross @ cross)
    return torch.eye(3, dtype=vectors.dtype, device=vectors.device) + turned


def quaternion_matrix(quaternions: Tensor) -> Tensor:
    """The rotations (...,3,3) of unit quaternions (...,4), x, y, z, w."""
    x, y, z, w = quaternions.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rotation_vector(rotations: Tensor) -> Tensor:
    r"""The axes times angles (...,3) of rotations (...,3,3): :func:`rotation_matrix` inverted, up to an angle of π.

    By way of the unit quaternion whose largest part is computed first, so that no angle loses digits.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in rotations.unbind(-2))
    # Each row is the quaternion times four times one of its parts; the row of the largest part is the most exact.
    rows = torch.stack(
        [
            torch.stack([1 + a + e + i, h - f, c - g, d - b], dim=-1),
            torch.stack([h - f, 1 + a - e - i, b + d, c + g], dim=-1),
            torch.stack([c - g, b + d, 1 - a + e - i, f + h], dim=-1),
            torch.stack([d - b, c + g, f + h, 1 - a - e + i], dim=-1),
        ],
        dim=-2,
    )
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*rows.shape[:-2], 1, 4)
    unit = torch.nn.functional.normalize(rows.gather(-2, largest)[..., 0, :], dim=-1)
    unit = torch.where(unit[..., :1] < 0, -unit, unit)
    sine = unit[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, unit[..., :1])
    return unit[..., 1:] * torch.where(sine < 1e-12, 2.0, angle / sine.clamp(min=1e-12))
