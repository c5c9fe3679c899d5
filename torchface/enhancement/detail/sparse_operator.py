"""Sparse products and solves of many columns at once, with derivatives."""

import warnings
from typing import Any

import numpy as np
import torch
from scipy import sparse
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchface.optim.sparse import SparseCholesky


class SparseOperator:
    """A constant sparse matrix (N,M), of any scipy format, for dense columns."""

    def __init__(self, matrix: sparse.sparray) -> None:
        self._matrix = sparse.csr_array(matrix, dtype=np.float64)
        self._matrix.sum_duplicates()
        self._prepared: dict[tuple[torch.dtype, torch.device, bool], Tensor] = {}

    @property
    def shape(self) -> tuple[int, int]:
        """(N,M)."""
        return self._matrix.shape[0], self._matrix.shape[1]

    def __call__(self, columns: Tensor) -> Tensor:
        """The products (N,C) with columns (M,C), of their dtype and device; differentiable."""
        product: Tensor = _Product.apply(columns, self)
        return product

    def __deepcopy__(self, memo: dict[int, object]) -> "SparseOperator":
        return self  # it never changes

    def multiplied(self, columns: Tensor, transposed: bool) -> Tensor:
        """Products of columns (N,C) with the matrix, or with its transpose."""
        key = columns.dtype, columns.device, transposed
        if key not in self._prepared:
            self._prepared[key] = _as_tensor(self._matrix.T.tocsr() if transposed else self._matrix, columns)
        return self._prepared[key] @ columns.contiguous()


def solved(factor: SparseCholesky, columns: Tensor) -> Tensor:
    """The solutions (V,C) of a factored system for columns (V,C); differentiable, as it is symmetric."""
    solution: Tensor = _Solution.apply(columns, factor)
    return solution


class _Solution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, columns: Tensor, factor: SparseCholesky) -> Tensor:
        ctx.factor = factor
        return factor.solve(columns)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return ctx.factor.solve(gradients[0]), None


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, columns: Tensor, operator: SparseOperator) -> Tensor:
        ctx.operator = operator
        return operator.multiplied(columns, transposed=False)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return ctx.operator.multiplied(gradients[0], transposed=True), None


def _as_tensor(matrix: sparse.csr_array, like: Tensor) -> Tensor:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr.astype(np.int32)),
            torch.from_numpy(matrix.indices.astype(np.int32)),
            torch.from_numpy(matrix.data).to(like.dtype),
            size=matrix.shape,
            device=like.device,
            check_invariants=True,
        )
