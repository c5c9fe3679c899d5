"""Rotation and stretch of deformation gradients, as nine numbers that can be blended."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchface.geometry.rotations import cross_matrix, rotation_matrix, rotation_vector

_ITERATIONS = 12
_SETTLED = 0.1  # times the precision: the square of a change, after which one more would change nothing
_SCALED = 6  # iterations
_SINGULAR = 1e-5  # of the determinant to the norm's cube: Newton's iteration needs more


def polar_parts(gradients: Tensor) -> tuple[Tensor, Tensor]:
    r"""Rotation and symmetric stretch (...,3,3) of each matrix (...,3,3), :math:`F = R S`.

    Newton's iteration for all at once. A mirrored or singular matrix gets its nearest rotation too; the stretch of a
    mirrored one then has a negative eigenvalue. Differentiable where the rotation is unique.

    Source: Higham 1986, Computing the polar decomposition; the derivative solves
    :math:`(\operatorname{tr} S\, I - S)\, \omega = \operatorname{axial}(R^\top dF - dF^\top R)`.

    Example:
        >>> R, S = polar_parts(torch.tensor([[0.0, -2.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
        >>> R.round().int().tolist(), S.diagonal().round().tolist()
        ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [3.0, 2.0, 1.0])
    """
    rotation: Tensor = _NearestRotation.apply(gradients)
    stretch = rotation.transpose(-1, -2) @ gradients
    return rotation, 0.5 * (stretch + stretch.transpose(-1, -2))


def encode_gradients(gradients: Tensor) -> Tensor:
    """Nine numbers of each gradient (...,3,3): the rotation vector, then xx, xy, xz, yy, yz, zz of the stretch - I.

    All are zero for the identity.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 4.2.
    """
    rotation, stretch = polar_parts(gradients)
    rows, columns = torch.triu_indices(3, 3, device=gradients.device)
    strain = (stretch - torch.eye(3, dtype=stretch.dtype, device=stretch.device))[..., rows, columns]
    return torch.cat([rotation_vector(rotation), strain], dim=-1)


def decode_gradients(parts: Tensor) -> Tensor:
    """The gradients (...,3,3) of nine numbers (...,9): :func:`encode_gradients` inverted."""
    xx, xy, xz, yy, yz, zz = parts[..., 3:].unbind(-1)
    strain = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=-1).unflatten(-1, (3, 3))
    rotation = rotation_matrix(parts[..., :3])
    return rotation + rotation @ strain


class _NearestRotation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gradients: Tensor) -> Tensor:
        matrices = gradients.reshape(-1, 3, 3)
        size = matrices.square().sum((-1, -2)).sqrt()
        # Newton would find a mirrored matrix's nearest reflection, and nothing for a singular one: rare, by SVD.
        odd = (torch.linalg.det(matrices) <= _SINGULAR * size**3).nonzero()[:, 0]
        rotation = _by_newton(matrices / size.clamp(min=torch.finfo(size.dtype).tiny)[:, None, None])
        if len(odd):
            rotation[odd] = _by_svd(matrices[odd])
        rotation = rotation.view(gradients.shape)
        ctx.save_for_backward(gradients, rotation)
        return rotation

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        given, rotation = ctx.saved_tensors
        transposed = rotation.transpose(-1, -2)
        stretch = transposed @ given
        trace = stretch.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        system = trace * torch.eye(3, dtype=given.dtype, device=given.device) - 0.5 * (
            stretch + stretch.transpose(-1, -2)
        )
        turned = _axial(transposed @ gradients[0])
        axis, _ = torch.linalg.solve_ex(system, turned)
        return rotation @ cross_matrix(axis.nan_to_num(0.0, 0.0, 0.0))


def _by_newton(matrices: Tensor) -> Tensor:
    # Nine planes of numbers, not many small matrices: a batch of 3x3 products costs five times as much.
    x = list(matrices.flatten(1).unbind(1))
    for step in range(_ITERATIONS):
        a, b, c, d, e, f, g, h, i = x
        cofactors = [
            e * i - f * h, f * g - d * i, d * h - e * g,
            c * h - b * i, a * i - c * g, b * g - a * h,
            b * f - c * e, c * d - a * f, a * e - b * d,
        ]  # fmt: skip
        det = a * cofactors[0] + b * cofactors[1] + c * cofactors[2]
        det = torch.where(det.abs() > 1e-30, det, 1e-30)
        # Scaled by the norms of matrix and inverse at first, which makes few steps of a stretch of any size.
        own, other = _square(x), _square(cofactors) / det.square()
        scale = (other / own.clamp(min=1e-30)).clamp(1e-20, 1e20).pow(0.25) if step < _SCALED else 1.0
        now = [0.5 * (scale * one + two / (scale * det)) for one, two in zip(x, cofactors, strict=True)]
        change = _square([one - two for one, two in zip(x, now, strict=True)])
        x = now
        if change.numel() == 0 or float(change.max()) < _SETTLED * torch.finfo(det.dtype).eps:
            break
    return torch.stack(x, dim=-1).unflatten(-1, (3, 3))


def _square(entries: list[Tensor]) -> Tensor:
    return sum((entry.square() for entry in entries), torch.zeros_like(entries[0]))


def _by_svd(matrices: Tensor) -> Tensor:
    u, _, vh = torch.linalg.svd(matrices)
    sign = torch.ones_like(u[..., 0])
    sign[..., -1] = torch.linalg.det(u @ vh).sign()
    return (u * sign[..., None, :]) @ vh


def _axial(matrices: Tensor) -> Tensor:
    """The vector whose cross product is the skew part, times two."""
    skew = matrices - matrices.transpose(-1, -2)
    return torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
