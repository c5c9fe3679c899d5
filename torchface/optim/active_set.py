r"""Projected Newton steps for box-constrained quadratic programs, batched: the exact end of a solve.

Variables at a bound whose gradient pushes outward are held; the others take the Newton step
:math:`-(H_{FF})^{-1} g_F`, clipped to the box at the step length of least objective. Near the solution the held set is
the active set and one Cholesky factorisation a problem ends at rounding error.

Source: Bertsekas 1982, Projected Newton methods for optimization problems with simple constraints.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.optim.box_problem import BoxProblem

# Numbers in the matrices factored at once: 2 MB of float64 stay in a CPU's cache; an accelerator wants more.
_CHUNK_NUMBERS = {"cpu": 2**18, "other": 2**25}
_STEP_LENGTHS = 10
# Added to the scaled diagonal (all ones) so that semidefinite blocks factor; raised a thousandfold where they do not.
_RIDGE = 1e-13
_RIDGE_TRIES = 5


def projected_newton(problem: BoxProblem, start: Tensor, tolerance: float, iterations: int = 100) -> Tensor:
    """The minimisers (B,N), from feasible ``start`` (B,N).

    Args:
        problem: B problems, float64.
        start: feasible points, (B,N).
        tolerance: on ``problem.residual``; a problem that reaches it is left alone.
        iterations: at most so many factorisations a problem; a handful is usual.
    """
    numbers = _CHUNK_NUMBERS.get(start.device.type, _CHUNK_NUMBERS["other"])
    chunk = max(1, numbers // problem.f.shape[1] ** 2)
    x = start.clone()
    for first in range(0, len(x), chunk):
        rows = torch.arange(first, min(first + chunk, len(x)), device=x.device)
        for _ in range(iterations):
            part = problem.rows(rows)
            here = x[rows]
            gradient = part.gradient(here)
            residual = part.residual(here, gradient)
            open_ = residual > part.rounding(here).clamp(min=tolerance)
            if not bool(open_.any()):
                break
            if not bool(open_.all()):
                rows, here, gradient = rows[open_], here[open_], gradient[open_]
                part, residual = problem.rows(rows), residual[open_]
            x[rows] = _step(part, here, gradient, residual)
    return x


def _step(problem: BoxProblem, x: Tensor, gradient: Tensor, residual: Tensor) -> Tensor:
    # A variable closer to its bound than the residual counts as at it, else the search path could collapse.
    near = residual.clamp(max=1e-3)[:, None]
    held = ((x - problem.lower <= near) & (gradient > 0)) | ((problem.upper - x <= near) & (gradient < 0))
    newton = solve_free(problem.H, problem.diagonal, ~held, -gradient)
    direction = torch.where(held, -gradient / problem.diagonal, newton)
    # The full step is right nearly always; only the others pay for the search.
    full = problem.clip(x + direction)
    moved = full - x
    # q(x + m) - q(x) = m'(g + Hm/2) without the cancellation of two objectives.
    change = (moved * (gradient + 0.5 * problem.curvature(moved))).sum(-1)
    promised = (gradient * moved).sum(-1)
    worse = change > 0.1 * promised
    if bool(worse.any()):
        full[worse] = _search(problem.rows(worse), x[worse], gradient[worse], direction[worse])
    return full


def _search(problem: BoxProblem, x: Tensor, gradient: Tensor, direction: Tensor) -> Tensor:
    """The best of halved steps and of a diagonal step, each clipped to the box."""
    best = problem.clip(x - gradient / problem.diagonal / len(problem.lower))
    moved = best - x
    least = (moved * (gradient + 0.5 * problem.curvature(moved))).sum(-1)
    for halvings in range(_STEP_LENGTHS):
        trial = problem.clip(x + 0.5**halvings * direction)
        moved = trial - x
        change = (moved * (gradient + 0.5 * problem.curvature(moved))).sum(-1)
        better = change < least
        best = torch.where(better[:, None], trial, best)
        least = torch.where(better, change, least)
    return best


def solve_free(H: Tensor, diagonal: Tensor, free: Tensor, right: Tensor) -> Tensor:
    r"""Solves :math:`H_{FF} x_F = b_F` with :math:`x = 0` elsewhere.

    Args:
        H: (N,N) or (B,N,N), positive semidefinite, float64.
        diagonal: the metric in which it is scaled, (N,) or (B,N).
        free: which variables take part, (B,N) bool.
        right: :math:`b`, (B,N).
    """
    scale = torch.where(free, diagonal.rsqrt(), 0.0)
    scaled = H * scale[:, :, None] * scale[:, None, :]
    entry = scaled.diagonal(dim1=-2, dim2=-1)
    entry += torch.where(free, _RIDGE, 1.0)
    right = (right * scale)[..., None]
    factor, info = torch.linalg.cholesky_ex(scaled)
    ridge = _RIDGE
    for _ in range(_RIDGE_TRIES):
        failed = info > 0
        if not bool(failed.any()):
            break
        ridge *= 1e3
        again = scaled[failed]
        again.diagonal(dim1=-2, dim2=-1).add_(ridge)
        factor[failed], info[failed] = torch.linalg.cholesky_ex(again)
    return torch.cholesky_solve(right, factor)[..., 0] * scale
