"""The inverse of a symmetric matrix in operations that ONNX has."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def swept_inverse(matrix: Tensor) -> Tensor:
    r"""The inverse (D,D) of a symmetric positive definite matrix, by D sweeps of rank one.

    Sweeping row k of B takes :math:`B - v v^\top / d` with :math:`v = B_k - e_k, d = B_{kk}`, and twice
    :math:`e_k e_k^\top`, which is subtracted from all rows at the start; at the end B is minus the inverse. ONNX has
    no factorisation; Newton's iteration takes more products the worse the matrix' condition is, this never does.

    Args:
        matrix: (D,D); no pivots are sought, so float64 for what is badly conditioned.

    Source: Goodnight 1979, A tutorial on the sweep operator.
    """
    size = int(matrix.shape[0])
    # From numpy, so that a traced graph has it as a constant.
    identity = torch.from_numpy(np.eye(size)).to(matrix)
    # With a diagonal of ones no sweep subtracts numbers that are large beside its own.
    scale = 1 / (matrix * identity).sum(0).sqrt()
    scales = scale[:, None] * scale
    # Minus the inverse plus the identity, which makes a row what a sweep takes of it.
    swept = matrix * scales - identity
    one = torch.from_numpy(np.ones((1, 1))).to(matrix)
    for k in range(size):  # each sweep needs the one before
        row = swept[k : k + 1]
        pivot = torch.addmm(one, row, identity[:, k : k + 1])
        swept = torch.addmm(swept, row.T, row / pivot, alpha=-1.0)
    return (identity - swept) * scales
