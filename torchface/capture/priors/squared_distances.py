"""Distances between rows of two matrices."""

from __future__ import annotations

from torch import Tensor


def squared_distances(first: Tensor, second: Tensor) -> Tensor:
    """(...,A,F) and (...,B,F) to (...,A,B), by one product.

    ``torch.cdist`` has wrong derivatives under ``torch.func.jacrev``.

    Example:
        >>> squared_distances(torch.tensor([[0.0, 0.0]]), torch.tensor([[3.0, 4.0], [0.0, 1.0]])).tolist()
        [[25.0, 1.0]]
    """
    lengths = first.square().sum(-1, keepdim=True) + second.square().sum(-1)[..., None, :]
    return (lengths - 2 * first @ second.transpose(-1, -2)).clamp(min=0.0)
