"""Rotations from their axis and angle."""

from __future__ import annotations

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

    Example:
        >>> (rotation_matrix(torch.tensor([0.0, 0.0, torch.pi / 2])) @ torch.tensor([1.0, 0.0, 0.0])).round().tolist()
        [0.0, 1.0, 0.0]
    """
    square = vectors.square().sum(-1)[..., None, None]
    small = square < 1e-12
    safe = torch.where(small, 1.0, square).sqrt()  # in this order: the root's slope at 0 is infinite
    first = torch.where(small, 1 - square / 6, safe.sin() / safe)
    # 2 sin²(θ/2)/θ² keeps the digits that 1 - cos θ loses.
    second = torch.where(small, 0.5 - square / 24, 2 * (safe / 2).sin().square() / safe.square())
    cross = cross_matrix(vectors)
    return torch.eye(3, dtype=vectors.dtype, device=vectors.device) + first * cross + second * (cross @ cross)
