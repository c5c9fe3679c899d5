"""Quadratic programs on the simplex in batches: convex combinations of many, of which few take part."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import checked_number
from torchface.optim.implicit import SimplexSolution

_TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-10}
_PROXIMAL = 1e-9  # of H's largest diagonal: makes the active set's system definite; repeated, it leaves no trace
_REPEATS, _TRIES = 4, 6
_MINOR = 60  # how often variables may leave between two that come
_SEVERAL, _NEARLY = 12, 0.3  # variables that enter at once at most, by their share of what the best one gives
_CHUNK_NUMBERS = 2**24  # of a gathered system, in all problems of a chunk


def simplex_qp(H: Tensor, f: Tensor, start: Tensor | None = None, tolerance: float | None = None) -> Tensor:
    r"""The minimisers of quadratic functions over the simplex.

    .. math:: x = \arg\min_{x \ge 0,\; \mathbf 1^\top x = 1} \tfrac12 x^\top H x + f^\top x

    An active set grows by the variables whose gradients lie furthest below the mean of those that take part, and loses
    those that a step would take below 0. Each step is exact, so it ends at the minimum; that few of many variables take
    part keeps the systems small. Float64 inside, all problems at once. Differentiable once in H and f, by implicit
    differentiation at the solution.

    Args:
        H: symmetric and positive semidefinite, (N,N) or (B,N,N), float32 or float64; only its symmetric part counts.
        f: (B,N), of the same dtype and device.
        start: a guess on the simplex, (B,N), such as the frame before: its positive variables take part first. The
            answer does not depend on it where it is unique.
        tolerance: on the residual :math:`\max_i (\mu - g_i)`, with g the gradient and :math:`\mu = x^\top g` the
            multiplier of the sum, relative to the range of :math:`\operatorname{diag} H` and f; 1e-6 for float32 and
            1e-10 for float64 if absent.

    Returns:
        x, (B,N), non-negative, of sum 1. Where the minimiser is not unique, one of them.

    Raises:
        ShapeError: the shapes do not fit each other.
        ValueRangeError: an entry is not finite, H is not symmetric or has a negative diagonal, or ``start`` is negative
            or of sum 0.

    Source: Wolfe 1976, Finding the nearest point in a polytope; Facial Performance Enhancement Using Dynamic Shape
    Space Analysis, section 5.3.

    Example:
        >>> H = torch.tensor([[2.0, 0.0], [0.0, 2.0]])
        >>> simplex_qp(H, torch.tensor([[0.0, 0.0], [0.0, -1.0], [5.0, 0.0]])).round(decimals=4).tolist()
        [[0.5, 0.5], [0.25, 0.75], [0.0, 1.0]]
    """
    _check(H, f, start)
    limit = _TOLERANCE[H.dtype] if tolerance is None else checked_number("simplex_qp: tolerance", tolerance, 0.0, 0.5)

    def solved() -> Tensor:
        exact = H.detach().double()
        exact = 0.5 * (exact + exact.transpose(-1, -2))
        begin = None if start is None else start.detach().double()
        return _solve_in_chunks(exact, f.detach().double(), begin, limit).to(f.dtype)

    if torch.is_grad_enabled() and (H.requires_grad or f.requires_grad):
        solution: Tensor = SimplexSolution.apply(H, f, solved)
        return solution
    with torch.no_grad():
        return solved()


def _solve_in_chunks(H: Tensor, f: Tensor, start: Tensor | None, tolerance: float) -> Tensor:
    count, variables = f.shape
    chunk = max(1, _CHUNK_NUMBERS // variables**2)
    pieces = []
    for first in range(0, count, chunk):
        rows = slice(first, first + chunk)
        part = H if H.ndim == 2 else H[rows]
        pieces.append(_solve(part, f[rows], None if start is None else start[rows], tolerance))
    return torch.cat(pieces) if pieces else f.clone()


@dataclass
class _ActiveSet:
    """The variables that take part, K places a problem, and their values.

    Args:
        index: (B,K); a place that is not taken holds 0.
        taken: (B,K) bool.
        value: (B,K), 0 where not taken.
        H: of the taken variables, (B,K,K), 0 elsewhere.
        f: (B,K), 0 where not taken.
    """

    index: Tensor
    taken: Tensor
    value: Tensor
    H: Tensor
    f: Tensor


def _solve(H: Tensor, f: Tensor, start: Tensor | None, tolerance: float) -> Tensor:
    count, variables = f.shape
    diagonal = H.diagonal(dim1=-2, dim2=-1).expand(count, -1)
    scale = diagonal.amax(1) + f.amax(1) - f.amin(1)
    scale = torch.where(scale > 0, scale, torch.ones_like(scale))
    x = torch.zeros_like(f)
    if start is None:
        x.scatter_(1, (0.5 * diagonal + f).argmin(1, keepdim=True), 1.0)
    else:
        x = start / start.sum(1, keepdim=True)
    x = _settled(H, f, x)
    # In turn: which variables help most, then the minimum with them. Several at once may hinder each other and all
    # leave again; one alone always lowers the energy, so every second turn brings one, and no set comes twice.
    for turn in range(40 * variables + 100):
        gradient = _bent(H, x) + f
        multiplier = (x * gradient).sum(1)
        slack = (gradient - multiplier[:, None]).masked_fill(x > 0, 0.0)
        least, best = slack.min(1)
        rows = (least < -tolerance * scale).nonzero()[:, 0]
        if not len(rows):
            return x
        entering = torch.zeros(len(rows), variables, dtype=torch.bool, device=x.device)
        entering.scatter_(1, best[rows, None], value=True)
        if turn % 2 == 0:
            several = slack[rows].topk(min(_SEVERAL, variables), dim=1, largest=False)
            entering.scatter_(1, several.indices, several.values < _NEARLY * least[rows, None])
        part = H if H.ndim == 2 else H[rows]
        x[rows] = _settled(part, f[rows], x[rows], entering)
    return x


def _settled(H: Tensor, f: Tensor, x: Tensor, entering: Tensor | None = None) -> Tensor:
    """The minimum over the variables above 0 and those that enter, (B,N) bool; those that fall to 0 leave."""
    takes_part = x > 0 if entering is None else (x > 0) | entering
    active = _gathered(H, f, x, takes_part)
    for _ in range(_MINOR + active.index.shape[1]):
        aim = _equality_minimum(active)
        step = aim - active.value
        falls = active.taken & (aim <= 0) & (step < 0)
        room = torch.where(falls, active.value / (-step).clamp(min=1e-300), torch.inf)
        length = room.amin(1).clamp(max=1.0)
        value = torch.where(active.taken, active.value + length[:, None] * step, 0.0)
        leaves = falls & (room <= length[:, None])
        active.value = value.masked_fill(leaves, 0.0).clamp(min=0)
        active.taken = active.taken & ~leaves
        active.value = active.value / active.value.sum(1, keepdim=True)
        # What stood at 0 and would fall leaves without a step; the others have moved.
        if not bool(leaves.any()):
            break
    return torch.zeros_like(x).scatter_add_(1, active.index, active.value)


def _gathered(H: Tensor, f: Tensor, x: Tensor, takes_part: Tensor) -> _ActiveSet:
    most = int(takes_part.sum(1).max())
    index = takes_part.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :most]
    taken = takes_part.gather(1, index)
    index = index.masked_fill(~taken, 0)
    both = taken[:, :, None] & taken[:, None, :]
    if H.ndim == 2:
        inner = H[index[:, :, None], index[:, None, :]]
    else:
        rows = torch.arange(len(H), device=H.device)[:, None, None]
        inner = H[rows, index[:, :, None], index[:, None, :]]
    return _ActiveSet(
        index,
        taken,
        x.gather(1, index).masked_fill(~taken, 0.0),
        inner.masked_fill(~both, 0.0),
        f.gather(1, index).masked_fill(~taken, 0.0),
    )


def _equality_minimum(active: _ActiveSet) -> Tensor:
    """The minimum with the sum alone kept, (B,K), near the present values where H leaves it open."""
    taken = active.taken.to(active.H)
    weight = _PROXIMAL * active.H.diagonal(dim1=1, dim2=2).amax(1).clamp(min=1e-12)
    inner = active.H * taken[:, :, None] * taken[:, None, :]
    for _ in range(_TRIES):  # rounding may leave a singular H with eigenvalues below 0
        factor, failed = torch.linalg.cholesky_ex(inner + torch.diag_embed(weight[:, None] * taken + (1 - taken)))
        if not bool(failed.any()):
            break
        weight = torch.where(failed > 0, 30 * weight, weight)
    ones = torch.cholesky_solve(taken[:, :, None], factor)[:, :, 0]
    aim = active.value
    for _ in range(_REPEATS):
        free = torch.cholesky_solve(((weight[:, None] * aim - active.f) * taken)[:, :, None], factor)[:, :, 0]
        aim = free + ones * ((1 - free.sum(1)) / ones.sum(1))[:, None]
    return aim


def _bent(H: Tensor, x: Tensor) -> Tensor:
    return x @ H if H.ndim == 2 else torch.bmm(H, x[..., None])[..., 0]


def _check(H: Tensor, f: Tensor, start: Tensor | None) -> None:
    if H.ndim not in (2, 3) or H.shape[-1] != H.shape[-2] or H.shape[-1] == 0:
        raise ShapeError(f"simplex_qp: found H {tuple(H.shape)}, expected (N,N) or (B,N,N)")
    if f.ndim != 2 or f.shape[1] != H.shape[-1] or (H.ndim == 3 and len(H) != len(f)):
        raise ShapeError(f"simplex_qp: found f {tuple(f.shape)} for H {tuple(H.shape)}, expected (B,{H.shape[-1]})")
    if H.dtype not in _TOLERANCE or f.dtype != H.dtype:
        raise ValueRangeError(f"simplex_qp: found {H.dtype} and {f.dtype}, expected float32 or float64 of both")
    if start is not None and start.shape != f.shape:
        raise ShapeError(f"simplex_qp: found start {tuple(start.shape)}, expected {tuple(f.shape)}")
    for name, values in (("H", H), ("f", f), ("start", start)):
        if values is not None and not bool(torch.isfinite(values.detach()).all()):
            raise ValueRangeError(f"simplex_qp: {name} holds NaN or infinite entries, expected finite ones")
    if start is not None and len(start) and not (float(start.amin()) >= 0 and float(start.sum(1).amin()) > 0):
        raise ValueRangeError("simplex_qp: found a negative start or one of sum 0, expected points of the simplex")
    known = H.detach()
    largest = float(known.abs().max())
    if float((known - known.transpose(-1, -2)).abs().max()) > 1e2 * torch.finfo(H.dtype).eps * H.shape[-1] * largest:
        raise ValueRangeError("simplex_qp: H is not symmetric")
    if float(known.diagonal(dim1=-2, dim2=-1).amin()) < 0:
        raise ValueRangeError("simplex_qp: H has a negative diagonal, expected a positive semidefinite one")
