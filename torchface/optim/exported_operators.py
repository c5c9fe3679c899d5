"""Operators without an ONNX form: PyTorch runs them by itself, exported graphs as loops that are written out."""

from typing import Any

import torch
from torch import Tensor

from torchface.optim.operator_splitting import RELAXATION


@torch.library.custom_op("torchface::symmetric_inverse", mutates_args=())
def symmetric_inverse(matrix: Tensor) -> Tensor:
    """The inverse (D,D) of a symmetric positive definite matrix (D,D); a matrix that has none raises nothing."""
    return torch.linalg.inv_ex(matrix).inverse.contiguous()


@symmetric_inverse.register_fake
def _(matrix: Tensor) -> Tensor:
    return torch.empty_like(matrix)


@torch.library.custom_op("torchface::shifted_inverse", mutates_args=())
def shifted_inverse(matrix: Tensor, rho: float) -> Tensor:
    """The inverse (D,D) of a positive definite matrix (D,D) whose diagonal grows by a share of itself.

    A graph takes products alone for it, as the shift bounds the condition; the less the share, the less exact.
    """
    return torch.linalg.inv_ex(matrix + rho * torch.diag(matrix.diagonal())).inverse.contiguous()


@shifted_inverse.register_fake
def _(matrix: Tensor, rho: float) -> Tensor:
    return torch.empty_like(matrix)


@torch.library.custom_op("torchface::box_splitting", mutates_args=())
def box_splitting(
    constant: Tensor, step: Tensor, double_step: Tensor, lower: Tensor, upper: Tensor, dual: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Steps of ``torchface.optim.operator_splitting`` from a dual (1,N): the last v and the clipped z, (1,N).

    ``constant`` is c (1,N), ``step`` G (N,N), ``double_step`` 2G + (2 - α) I; the box is (N,).
    """
    v, z = dual, torch.zeros_like(dual)
    for _ in range(steps):  # each needs the one before
        v = torch.addmm(torch.addmm(constant, v, step, alpha=-1.0), z, double_step)
        z = torch.minimum(torch.maximum(v, lower), upper)
    return v, z


@box_splitting.register_fake
def _(constant: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return torch.empty_like(constant), torch.empty_like(constant)


def split_box_program(
    H: Tensor, gradient: Tensor, lower: Tensor, upper: Tensor, dual: Tensor, identity: Tensor, rho: float, steps: int
) -> tuple[Tensor, Tensor]:
    r"""The least of :math:`\tfrac12 x^\top H x + g^\top x` in a box, (1,D), and the dual (D,), with a metric of
    ``rho`` of H's diagonal."""
    diagonal = (H * identity).sum(0)
    inverse = symmetric_inverse(H + rho * diagonal * identity)
    return _split(_prepared(inverse, H, gradient, identity, rho), (lower, upper), dual, steps, H.dtype)


def split_box_program_quickly(
    H: Tensor, gradient: Tensor, lower: Tensor, upper: Tensor, dual: Tensor, identity: Tensor, rho: float, steps: int
) -> tuple[Tensor, Tensor]:
    """As :func:`split_box_program`, its steps in single precision, in a tenth of the operators of a graph."""
    inverse = shifted_inverse(H, rho)
    z, dual = _split(_prepared(inverse, H, gradient, identity, rho), (lower, upper), dual, steps, torch.float32)
    return z.to(H), dual.to(H)


def _prepared(inverse: Tensor, H: Tensor, gradient: Tensor, identity: Tensor, rho: float) -> tuple[Tensor, ...]:
    """What every step of a program takes: its constant and two matrices."""
    offset = -RELAXATION * inverse
    step = -rho * (H * identity).sum(0)[:, None] * offset - identity
    return gradient[None] @ offset, step, 2 * step + (2 - RELAXATION) * identity


def _split(
    prepared: tuple[Tensor, ...], box: tuple[Tensor, Tensor], dual: Tensor, steps: int, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    v, z = box_splitting(*(value.to(dtype) for value in (*prepared, *box, dual[None])), steps)
    return z, (v - z)[0]
