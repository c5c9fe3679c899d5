"""Sparse symmetric positive definite systems: one factorisation, many right-hand sides."""

from typing import TypeVar

import numpy as np
import qdldl
import torch
from scipy import sparse
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError

Array = TypeVar("Array", np.ndarray, Tensor)


class SparseCholesky:
    r"""A sparse matrix factored once, in float64 on the CPU, to solve with many right-hand sides.

    .. math:: A = P L D L^\top P^\top, \qquad x = P L^{-\top} D^{-1} L^{-1} P^\top b

    Args:
        matrix: :math:`A`, (n,n), any scipy sparse format, symmetric positive definite. Only its lower triangle is read.

    Source: QDLDL (Stellato, Banjac, Goulart, Bemporad, Boyd 2020), in the order of AMD (Amestoy, Davis, Duff 1996).
    """

    def __init__(self, matrix: sparse.sparray | sparse.spmatrix) -> None:
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
            raise ShapeError(f"SparseCholesky: found a matrix of {tuple(matrix.shape)}, expected (n,n)")
        self.size = int(matrix.shape[0])
        # The lower triangle by rows is the upper one by columns, which QDLDL reads.
        upper = sparse.csr_array(sparse.tril(matrix, format="csr"), dtype=np.float64).T
        if not np.isfinite(upper.data).all():
            raise ValueRangeError("SparseCholesky: the matrix holds NaN or infinite entries; expected none")
        if self.size == 0:
            return
        # QDLDL asks for every diagonal entry, and factors indefinite matrices too: the pivots' signs show it.
        if not (upper.diagonal() > 0).all():
            raise ValueRangeError("SparseCholesky: a diagonal entry is not positive; expected a definite matrix")
        try:
            self._factor = qdldl.Solver(upper, upper=True)
        except RuntimeError as error:
            raise ValueRangeError("SparseCholesky: the matrix is not positive definite") from error
        if not (self._factor.factors()[1] > 0).all():
            raise ValueRangeError("SparseCholesky: the matrix is not positive definite")

    def __deepcopy__(self, memo: dict[int, object]) -> "SparseCholesky":
        return self  # it never changes

    def solve(self, rhs: Array) -> Array:
        """The solution x of A x = b for b (n,) or (n,K), an array or tensor of its kind, dtype and device.

        It is computed in float64.
        """
        if rhs.ndim not in (1, 2) or rhs.shape[0] != self.size:
            raise ShapeError(f"SparseCholesky: found a right-hand side {tuple(rhs.shape)}, expected ({self.size},*)")
        if isinstance(rhs, Tensor):
            solved = self._solve(rhs.detach().cpu().numpy())
            return torch.from_numpy(solved).to(rhs.device, rhs.dtype)
        return self._solve(rhs).astype(rhs.dtype, copy=False)

    def _solve(self, rhs: np.ndarray) -> np.ndarray:
        values = np.asarray(rhs, dtype=np.float64)
        if values.size == 0:
            return np.zeros_like(values)
        if values.ndim == 1:
            return self._factor.solve(values)
        # QDLDL takes one right-hand side at a time.
        return np.stack([self._factor.solve(np.ascontiguousarray(column)) for column in values.T], axis=1)
