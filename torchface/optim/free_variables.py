"""Linear systems in the free variables of box-constrained quadratic programs, batched: only these are factored."""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg.lapack import dposv
from torch import Tensor
from torch.nn.functional import pad

# Numbers in the matrices factored at once: 1 MB of float64 stays near a CPU's second-level cache; an accelerator wants
# more.
_CHUNK_NUMBERS = {"cpu": 2**17, "other": 2**25}
# Added to the scaled diagonal, so that semidefinite blocks factor; raised a thousandfold where they do not.
_RIDGE = 1e-13
_RIDGE_TRIES = 5


def solve_free(H: Tensor, diagonal: Tensor, free: Tensor, right: Tensor, damping: Tensor | None = None) -> Tensor:
    r"""Solves :math:`(H_{FF} + \delta D) x_F = b_F` with :math:`x = 0` elsewhere.

    Problems are sorted by how many variables are free, so that those factored together are of nearly one size.

    Args:
        H: (N,N) or (B,N,N), positive semidefinite, float64.
        diagonal: the metric in which it is scaled, (N,) or (B,N).
        free: which variables take part, (B,N) bool.
        right: :math:`b`, (B,N).
        damping: :math:`\delta`, (B,); none if absent.
    """
    size = H.shape[-1] + 1
    scale = diagonal.rsqrt()
    # A row and a column of zeros pad the blocks of problems with fewer free variables.
    scaled = pad(H * scale[..., :, None] * scale[..., None, :], (0, 1, 0, 1))
    wide = pad(right * scale, (0, 1))
    counts, order = free.sum(-1).sort(descending=True)
    most = counts.tolist()
    numbers = _CHUNK_NUMBERS.get(H.device.type, _CHUNK_NUMBERS["other"])
    solved = torch.zeros_like(wide)
    first = 0
    while first < len(most) and most[first]:
        last = first + max(1, numbers // most[first] ** 2)
        rows = order[first:last]
        ids = _free_ids(free[rows], counts[first:last], most[first])
        places = ids[:, :, None] * size + ids[:, None, :]
        matrices = scaled if H.ndim == 2 else scaled[rows]
        if H.ndim == 3:
            places += (torch.arange(len(rows), device=rows.device) * size**2)[:, None, None]
        # Over twice as quick as ``take``, and quicker still for short integers.
        places = places.int() if matrices.numel() < 2**31 else places
        block = matrices.view(-1).index_select(0, places.view(-1)).view_as(places)
        ridge = _RIDGE if damping is None else damping[rows, None].clamp(min=_RIDGE)
        block.diagonal(dim1=-2, dim2=-1).add_(torch.where(ids == size - 1, 1.0, ridge))
        x = _factored_solve(block, wide[rows].gather(1, ids))
        solved[rows] = torch.zeros_like(wide[: len(rows)]).scatter_(1, ids, x)
        first = last
    return solved[:, :-1] * scale


def _free_ids(free: Tensor, counts: Tensor, size: int) -> Tensor:
    """The free variables of each problem, (B,size), those of a shorter one followed by N."""
    row, column = free.nonzero(as_tuple=True)
    first = counts.cumsum(0) - counts
    place = torch.arange(len(row), device=row.device) - first[row]
    ids = torch.full((len(free), size), free.shape[1], device=row.device)
    ids[row, place] = column
    return ids


def _factored_solve(block: Tensor, right: Tensor) -> Tensor:
    """Solves a system each, (B,S), of blocks (B,S,S), which it may overwrite."""
    if block.device.type != "cpu":
        factor, failures = torch.linalg.cholesky_ex(block)
        return _lifted_solve(block, right, torch.cholesky_solve(right[..., None], factor)[..., 0], failures > 0)
    diagonal = block.diagonal(dim1=1, dim2=2).clone()
    vectors = right.numpy()
    found, info = np.empty_like(vectors), np.zeros(len(vectors), dtype=bool)
    # One by one: torch's batched factorisation does so too, and twice as slowly.
    for row, (matrix, vector) in enumerate(zip(block.numpy(), vectors, strict=True)):
        _, found[row], code = dposv(matrix.T, vector, lower=1, overwrite_a=1)
        info[row] = code > 0
    solved, failed = torch.from_numpy(found), torch.from_numpy(info)
    if failed.any():
        # The factor lies in the upper triangle.
        block = block.tril(-1)
        block = block + block.mT + diagonal.diag_embed()
    return _lifted_solve(block, right, solved, failed)


def _lifted_solve(block: Tensor, right: Tensor, solved: Tensor, failed: Tensor) -> Tensor:
    """Solves with a ridge where factoring failed."""
    ridge = _RIDGE
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
