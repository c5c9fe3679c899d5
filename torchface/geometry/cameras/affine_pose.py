"""The pose in which an affine camera sees points as they are seen: products alone, where no search can be afforded."""

import torch
from torch import Tensor

from torchface.optim.exported_operators import symmetric_inverse

_FLAT = 1e-6  # of the squared variance of points, that of a line


def affine_pose(points: Tensor, rays: Tensor, trust: Tensor) -> tuple[Tensor, Tensor]:
    """The pose, (3,3) and (3,) mm, in which an affine camera sees points (L,3), not in a plane, along rays (L,2).
    Source: DeMenthon and Davis 1995, the first iteration of POSIT."""
    proportion = (trust / trust.sum())[:, None]
    centre, middle = (proportion * points).sum(0), (proportion * rays).sum(0)
    x, q = (points - centre) * proportion, rays - middle
    projection = (q.T @ x) @ symmetric_inverse((points - centre).T @ x)
    size = projection.square().sum(1).sqrt()
    rotation = orthonormal(projection)
    depth = 2 / (size[0] + size[1])
    return rotation, depth * torch.nn.functional.pad(middle, (0, 1), value=1.0) - rotation @ centre


def orthonormal(matrix: Tensor) -> Tensor:
    """The rotation (3,3) of a matrix' first two rows."""
    first = matrix[0] / matrix[0].square().sum().sqrt()
    second = matrix[1] - (first @ matrix[1]) * first
    second = second / second.square().sum().sqrt()
    return torch.stack([first, second, torch.linalg.cross(first, second)])


def spreads(points: Tensor, seen: Tensor) -> Tensor:
    """Whether points (...,L,2), pixels, as far as they are seen, (...,L) bool, lie neither in one place nor on a line,
    (...) bool. Finders give landmarks that do where they find no face.
    """
    seen = seen[..., None]
    count, points = seen.double().sum(-2, keepdim=True).clamp(min=1.0), torch.where(seen, points.double(), 0.0)
    away = torch.where(seen, points - points.sum(-2, keepdim=True) / count, 0.0)
    a, b, _, c = (away.mT @ away / count).flatten(-2).unbind(-1)
    return a * c - b * b > _FLAT * ((a + c).square() + 1.0)
