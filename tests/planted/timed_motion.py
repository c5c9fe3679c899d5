"""Motions of a face whose timing is known."""

import torch
from torch import Tensor


def random_points(seed: int, count: int, dimensions: int = 3) -> Tensor:
    return torch.randn(count, dimensions, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def slow_then_fast(frames: int) -> Tensor:
    return torch.linspace(0, 1, frames, dtype=torch.float64) ** 3


def motion(progress: Tensor) -> Tensor:
    """Features (n,4,9) of a face that goes straight from rest to an extreme."""
    return progress[:, None, None] * random_points(5, 36).flatten()[:36].reshape(1, 4, 9)
