"""Sparse symmetric positive definite systems: one factorisation, many right-hand sides."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from cholespy import CholeskySolverD, MatrixType
from scipy import sparse
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError

Array = TypeVar("Array", np.ndarray, Tensor)


class SparseCholesky:
    r"""A sparse matrix factored once, in float64 on the CPU, to solve with many right-hand sides.

    .. math:: A = L L^\top, \qquad x = L^{-\top} L^{-1} b

    Args:
        matrix: :math:`A`, (n,n), any scipy sparse format, symmetric positive definite. Only its lower triangle is read.

    Raises:
        ShapeError: the matrix is not square.
        ValueRangeError: an entry is NaN or infinite, or the matrix is not positive definite.

    Source: CHOLMOD (Chen, Davis, Hager, Rajamanickam 2008), by way of cholespy.

    Example:
        >>> solver = SparseCholesky(sparse.diags_array([4.0, 16.0]))
        >>> solver.solve(np.array([4.0, 8.0])).tolist()
        [1.0, 0.5]
    """

    def __init__(self, matrix: sparse.sparray | sparse.spmatrix) -> None:
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
            raise ShapeError(f"SparseCholesky: found a matrix of {tuple(matrix.shape)}, expected (n,n)")
        self.size = int(matrix.shape[0])
        lower = sparse.csc_array(sparse.tril(matrix, format="csc"), dtype=np.float64)
        if not np.isfinite(lower.data).all():
            raise ValueRangeError("SparseCholesky: the matrix holds NaN or infinite entries; expected none")
        if self.size == 0:
            return
        # CHOLMOD complains on stderr before it raises; a diagonal that cannot be is caught here in silence.
        if not (lower.diagonal() > 0).all():
            raise ValueRangeError("SparseCholesky: a diagonal entry is not positive; expected a definite matrix")
        indptr, indices = lower.indptr.astype(np.int32), lower.indices.astype(np.int32)
        try:
            self._factor = CholeskySolverD(self.size, indptr, indices, lower.data, MatrixType.CSC)
        except ValueError as error:
            raise ValueRangeError("SparseCholesky: the matrix is not positive definite") from error

    def solve(self, rhs: Array) -> Array:
        """The solution x of A x = b.

        Args:
            rhs: b, (n,) or (n,K), a numpy array or a tensor.

        Returns:
            x, of the same kind, shape, floating dtype and device as ``rhs``; computed in float64.

        Raises:
            ShapeError: ``rhs`` does not have n rows.
        """
        if rhs.ndim not in (1, 2) or rhs.shape[0] != self.size:
            raise ShapeError(f"SparseCholesky: found a right-hand side {tuple(rhs.shape)}, expected ({self.size},*)")
        if isinstance(rhs, Tensor):
            solved = self._solve(rhs.detach().cpu().numpy())
            return torch.from_numpy(solved).to(rhs.device, rhs.dtype)
        return self._solve(rhs).astype(rhs.dtype, copy=False)

    def _solve(self, rhs: np.ndarray) -> np.ndarray:
        values = np.ascontiguousarray(rhs, dtype=np.float64)
        solution = np.zeros_like(values)
        if solution.size:
            self._factor.solve(values, solution)
        return solution
