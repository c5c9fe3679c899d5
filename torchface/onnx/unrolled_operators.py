"""The ONNX form of ``torchface.optim.exported_operators``: loops written out."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from torchface.onnx.exported_model import OPSET
from torchface.optim import exported_operators

_NEWTON_STEPS = 14  # to a residual of 1e-9 for rows' sums of 30 and a share of 0.05


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


def _newton_inverse(matrix: Any, rho: float) -> Any:
    r"""``shifted_inverse`` by Newton's iteration in single precision, :math:`X' = X (2 I - A X)`, the last in double.

    With a diagonal of ones before it grew, no eigenvalue is below :math:`\rho` and none beyond the largest sum of a
    row's absolute values, by which the identity is divided to begin with.

    Source: Schulz 1933; Ben-Israel 1965 for the start.
    """
    from onnx import TensorProto
    from onnxscript import ir

    op, size = _onnx_operators(), int(matrix.shape[0])
    identity = op.Constant(value=ir.tensor(np.eye(size)))
    diagonal = op.ReduceSum(op.Mul(matrix, identity), op.Constant(value_ints=[0]), keepdims=1)
    scale = op.Reciprocal(op.Sqrt(diagonal))
    scales = op.Mul(op.Transpose(scale, perm=[1, 0]), scale)
    scaled = op.Add(op.Mul(matrix, scales), op.Constant(value=ir.tensor(rho * np.eye(size))))
    quick = op.Cast(scaled, to=TensorProto.FLOAT)
    rows = op.ReduceSum(op.Abs(quick), op.Constant(value_ints=[1]), keepdims=1)
    found = op.Div(op.Constant(value=ir.tensor(np.eye(size, dtype=np.float32))), op.ReduceMax(rows, keepdims=1))
    twice = op.Constant(value=ir.tensor(2 * np.eye(size, dtype=np.float32)))
    for _ in range(_NEWTON_STEPS):  # each doubles the digits that are right
        found = op.MatMul(found, op.Gemm(quick, found, twice, alpha=-1.0))
    found = op.Cast(found, to=TensorProto.DOUBLE)
    left = op.Sub(op.Constant(value=ir.tensor(2 * np.eye(size))), op.MatMul(scaled, found))
    return op.Mul(op.MatMul(found, left), scales)


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
    exported_operators.symmetric_inverse._opoverload: _sweep_inverse,
    exported_operators.shifted_inverse._opoverload: _newton_inverse,
    exported_operators.box_splitting._opoverload: _unrolled_splitting,
}
"""For ``exported_model``."""


def _onnx_operators() -> Any:
    # Loaded where a graph is written: solvers that run graphs have no need of it. As annotated, its constants fit none
    # of its operators.
    import onnxscript

    return getattr(onnxscript, f"opset{OPSET}")
