"""Operators without an ONNX form: PyTorch runs them by itself, an exported graph as loops written out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor


@torch.library.custom_op("torchface::symmetric_inverse", mutates_args=())
def symmetric_inverse(matrix: Tensor) -> Tensor:
    """The inverse (D,D) of a symmetric positive definite matrix (D,D); a matrix that has none raises nothing."""
    return torch.linalg.inv_ex(matrix).inverse.contiguous()


@symmetric_inverse.register_fake
def _(matrix: Tensor) -> Tensor:
    return torch.empty_like(matrix)


def _sweep_inverse(matrix: Any) -> Any:
    r"""``symmetric_inverse`` in float64 by D sweeps of rank one; ONNX has no factorisation.

    Sweeping row k of B takes :math:`B - v v^\top / d` with :math:`v = B_k - e_k, d = B_{kk}`, and twice
    :math:`e_k e_k^\top`, which is subtracted from all rows at the start; at the end B is minus the inverse. Newton's
    iteration takes more products the worse the matrix' condition is, this never does.

    Source: Goodnight 1979, A tutorial on the sweep operator.
    """
    from onnxscript import ir

    op, size = _onnx_operators(), int(matrix.shape[0])
    identity, one = op.Constant(value=ir.tensor(np.eye(size))), op.Constant(value=ir.tensor(np.ones((1, 1))))
    # With a diagonal of ones no sweep subtracts numbers that are large beside its own.
    diagonal = op.ReduceSum(op.Mul(matrix, identity), op.Constant(value_ints=[0]), keepdims=1)
    scale = op.Reciprocal(op.Sqrt(diagonal))
    scales = op.Mul(op.Transpose(scale, perm=[1, 0]), scale)
    # Minus the inverse plus the identity, which makes a row what a sweep takes of it.
    swept = op.Sub(op.Mul(matrix, scales), identity)
    for k in range(size):  # each sweep needs the one before
        place = op.Constant(value_ints=[k])
        row = op.Gather(swept, place, axis=0)
        pivot = op.Add(op.Gather(row, place, axis=1), one)
        swept = op.Gemm(row, op.Div(row, pivot), swept, alpha=-1.0, transA=1)
    return op.Mul(op.Sub(identity, swept), scales)


@torch.library.custom_op("torchface::box_splitting", mutates_args=())
def box_splitting(
    constant: Tensor, step: Tensor, double_step: Tensor, lower: Tensor, upper: Tensor, dual: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Steps of ``torchface.optim.operator_splitting`` from zero: the last v and the clipped z, (1,N).

    Args:
        constant: c, (1,N).
        step: G, (N,N).
        double_step: 2G + (2 - α) I, (N,N).
        lower, upper: the box, (N,).
        dual: the scaled dual to start from, (1,N).
        steps: how many.
    """
    v, z = dual, torch.zeros_like(dual)
    for _ in range(steps):  # each needs the one before
        v = torch.addmm(torch.addmm(constant, v, step, alpha=-1.0), z, double_step)
        z = torch.minimum(torch.maximum(v, lower), upper)
    return v, z


@box_splitting.register_fake
def _(constant: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return torch.empty_like(constant), torch.empty_like(constant)


def _unrolled_splitting(
    constant: Any, step: Any, double_step: Any, lower: Any, upper: Any, dual: Any, steps: int
) -> tuple[Any, Any]:
    op = _onnx_operators()
    v, z = dual, op.Sub(dual, dual)
    for _ in range(steps):
        v = op.Gemm(z, double_step, op.Gemm(v, step, constant, alpha=-1.0))
        z = op.Min(op.Max(v, lower), upper)
    return v, z


TRANSLATIONS: Mapping[Callable[..., object], Callable[..., object]] = {
    torch.ops.torchface.symmetric_inverse.default: _sweep_inverse,
    torch.ops.torchface.box_splitting.default: _unrolled_splitting,
}
"""For ``exported_model``."""


def _onnx_operators() -> Any:
    # Loaded where a graph is written: solvers that run graphs have no need of it. As annotated, its constants fit none
    # of its operators.
    from onnxscript import opset18

    return opset18
