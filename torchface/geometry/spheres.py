"""Spheres near points."""

import torch
from torch import Tensor


def nearest_sphere(points: Tensor) -> tuple[Tensor, float]:
    """The sphere nearest to points (n,3), by least squares of squared distances: middle (3,) and radius.

    Example:
        >>> ball = 2 * torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=1) + 1
        >>> middle, radius = nearest_sphere(ball)
        >>> middle.round(decimals=3).tolist(), round(radius, 3)
        ([1.0, 1.0, 1.0], 2.0)
    """
    origin = points.mean(0)
    away = points - origin
    system = torch.cat([2 * away, torch.ones(len(points), 1).to(points)], 1)
    solved = torch.linalg.lstsq(system, away.square().sum(-1, keepdim=True)).solution[:, 0]
    return origin + solved[:3], float((solved[3] + solved[:3].square().sum()).clamp(min=0).sqrt())
