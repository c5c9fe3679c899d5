"""Linear systems in the free variables of box-constrained quadratic programs, batched: only these are factored."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import torch
from scipy.linalg.lapack import dposv
from torch import Tensor

Array: TypeAlias = "np.ndarray"

# Numbers in the matrices that an accelerator factors at once.
_CHUNK_NUMBERS = 2**25
# Added to the scaled diagonal, so that semidefinite blocks factor; raised a thousandfold where they do not.
RIDGE = 1e-13
_RIDGE_TRIES = 5


def solve_free(H: Tensor, diagonal: Tensor, free: Tensor, right: Tensor, damping: Tensor | None = None) -> Tensor:
    r"""Solves :math:`(H_{FF} + \delta D) x_F = b_F` with :math:`x = 0` elsewhere.

    Args:
        diagonal: the metric in which it is scaled, (N,) or (B,N).
        free: which variables take part, (B,N) bool.
    """
    scale = diagonal.rsqrt()
    scaled = H * scale[..., :, None] * scale[..., None, :]
    ridge = right.new_full((len(right),), RIDGE) if damping is None else damping.clamp(min=RIDGE)
    solve = _solved_one_by_one if right.device.type == "cpu" else _solved_at_once
    return solve(scaled, free, right * scale, ridge) * scale


def _solved_one_by_one(scaled: Tensor, free: Tensor, right: Tensor, ridge: Tensor) -> Tensor:
    """By NumPy and LAPACK: torch's batched factorisation goes one by one too, and more slowly."""
    found = torch.zeros_like(right)
    every = scaled.numpy() if scaled.ndim == 3 else [scaled.numpy()] * len(right)
    rows = zip(every, free.numpy(), right.numpy(), found.numpy(), ridge.tolist(), strict=True)
    for matrix, taken, side, solution, lift in rows:
        ids = taken.nonzero()[0]
        if len(ids):
            solution[ids] = _solution(matrix, ids, side, lift)
    return found


def _solution(matrix: Array, ids: Array, side: Array, ridge: float) -> Array:
    """Of one system, of some variables; with a greater ridge where it does not factor."""
    for _ in range(1 + _RIDGE_TRIES):
        block = matrix.take(ids, 0).take(ids, 1)
        block.ravel()[:: len(ids) + 1] += ridge
        _, x, failed = dposv(block.T, side.take(ids), lower=1, overwrite_a=1, overwrite_b=1)
        if not failed:
            break
        ridge = max(1e3 * ridge, 1e3 * RIDGE)
    return x


def _solved_at_once(scaled: Tensor, free: Tensor, right: Tensor, ridge: Tensor) -> Tensor:
    """On an accelerator: all variables are factored, those that are held as rows of the identity."""
    solved = torch.zeros_like(right)
    for rows in torch.arange(len(right), device=right.device).split(max(1, _CHUNK_NUMBERS // right.shape[1] ** 2)):
        taken = free[rows]
        matrices = scaled if scaled.ndim == 2 else scaled[rows]
        block = torch.where(taken[:, :, None] & taken[:, None], matrices, 0.0)
        block.diagonal(dim1=-2, dim2=-1).add_(torch.where(taken, ridge[rows, None], 1.0))
        solved[rows] = _factored_solve(block, torch.where(taken, right[rows], 0.0))
    return solved


def _factored_solve(block: Tensor, right: Tensor) -> Tensor:
    """Solves a system each, (B,S), of blocks (B,S,S); with a ridge where factoring fails."""
    factor, failures = torch.linalg.cholesky_ex(block)
    solved, failed = torch.cholesky_solve(right[..., None], factor)[..., 0], failures > 0
    ridge = RIDGE
    for _ in range(_RIDGE_TRIES):
        rows = failed.nonzero()[:, 0]
        if not len(rows):
            break
        ridge *= 1e3
        again = block[rows]
        again.diagonal(dim1=-2, dim2=-1).add_(ridge)
        factor, info = torch.linalg.cholesky_ex(again)
        solved[rows] = torch.cholesky_solve(right[rows, :, None], factor)[..., 0]
        failed[rows] = info > 0
    return solved
