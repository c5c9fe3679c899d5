"""Linear systems in the free variables of box-constrained quadratic programs, batched: only these are factored."""

from typing import TypeAlias

import numpy as np
import torch
from scipy.linalg.lapack import dposv
from torch import Tensor
from torch.nn.functional import pad

from torchface.optim.blas_threads import one_blas_thread

Array: TypeAlias = "np.ndarray"

# Numbers in the matrices that an accelerator factors at once.
_CHUNK_NUMBERS = 2**25
# Added to the scaled diagonal, so that semidefinite blocks factor; raised a thousandfold where they do not.
RIDGE = 1e-13
_RIDGE_TRIES = 5


def solve_free(H: Tensor, diagonal: Tensor, free: Tensor, right: Tensor, damping: Tensor | None = None) -> Tensor:
    r"""Solves :math:`(H_{FF} + \delta D) x_F = b_F` for ``free`` (B,N), :math:`x = 0` elsewhere, in a metric (N,) or
    (B,N)."""
    ridge = right.new_full((len(right),), RIDGE) if damping is None else damping.clamp(min=RIDGE)
    if right.device.type == "cpu":
        return _solved_one_by_one(H, diagonal, free, right, ridge)
    scale = diagonal.rsqrt()
    scaled = H * scale[..., :, None] * scale[..., None, :]
    return _solved_at_once(scaled, free, right * scale, ridge) * scale


def _solved_one_by_one(H: Tensor, diagonal: Tensor, free: Tensor, right: Tensor, ridge: Tensor) -> Tensor:
    """By NumPy and LAPACK: torch's batched factorisation goes one by one too, and more slowly.

    A Cholesky factor is as exact in any scale, so nothing is scaled but the ridge.
    """
    found = torch.zeros_like(right)
    every = H.numpy() if H.ndim == 3 else [H.numpy()] * len(right)
    lifts = diagonal.expand_as(right).numpy()
    rows = zip(every, lifts, free.numpy(), right.numpy(), found.numpy(), ridge.tolist(), strict=True)
    with one_blas_thread(H.shape[-1]):
        for matrix, lift, taken, side, solution, share in rows:
            ids = taken.nonzero()[0]
            if len(ids):
                solution[ids] = _solution(matrix, lift, ids, side, share)
    return found


def _solution(matrix: Array, lift: Array, ids: Array, side: Array, ridge: float) -> Array:
    """Of one system, of some variables; with a greater ridge where it does not factor."""
    for _ in range(1 + _RIDGE_TRIES):
        block = matrix.take(ids, 0).take(ids, 1)
        block.ravel()[:: len(ids) + 1] += ridge * lift.take(ids)
        _, x, failed = dposv(block.T, side.take(ids), lower=1, overwrite_a=1, overwrite_b=1)
        if not failed:
            break
        ridge = max(1e3 * ridge, 1e3 * RIDGE)
    return x


def _solved_at_once(scaled: Tensor, free: Tensor, right: Tensor, ridge: Tensor) -> Tensor:
    """Problems are sorted by how many variables are free, so that those factored together are of nearly one size."""
    size = scaled.shape[-1] + 1
    # A row and a column of zeros pad the blocks of problems with fewer free variables.
    scaled, wide = pad(scaled, (0, 1, 0, 1)), pad(right, (0, 1))
    counts, order = free.sum(-1).sort(descending=True)
    most = counts.tolist()
    solved = torch.zeros_like(wide)
    first = 0
    while first < len(most) and most[first]:
        last = first + max(1, _CHUNK_NUMBERS // most[first] ** 2)
        rows = order[first:last]
        ids = _free_ids(free[rows], counts[first:last], most[first])
        places = ids[:, :, None] * size + ids[:, None, :]
        matrices = scaled if scaled.ndim == 2 else scaled[rows]
        if scaled.ndim == 3:
            places += (torch.arange(len(rows), device=rows.device) * size**2)[:, None, None]
        block = matrices.view(-1).index_select(0, places.view(-1)).view_as(places)
        block.diagonal(dim1=-2, dim2=-1).add_(torch.where(ids == size - 1, 1.0, ridge[rows, None]))
        x = _factored_solve(block, wide[rows].gather(1, ids))
        solved[rows] = torch.zeros_like(wide[: len(rows)]).scatter_(1, ids, x)
        first = last
    return solved[:, :-1]


def _free_ids(free: Tensor, counts: Tensor, size: int) -> Tensor:
    """The free variables of each problem, (B,size), those of a shorter one followed by N."""
    row, column = free.nonzero(as_tuple=True)
    first = counts.cumsum(0) - counts
    place = torch.arange(len(row), device=row.device) - first[row]
    ids = torch.full((len(free), size), free.shape[1], device=row.device)
    ids[row, place] = column
    return ids


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
