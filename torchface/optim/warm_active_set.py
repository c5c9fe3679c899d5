"""A box-constrained quadratic program from a start whose active set is all but right: a factorisation or two."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import torch
from scipy.linalg.lapack import dposv
from torch import Tensor

from torchface.number_checks import checked_count, checked_number
from torchface.optim.active_set import projected_newton
from torchface.optim.box_problem import BoxProblem, check_box, metric

Array: TypeAlias = "np.ndarray"

_CHANGES = 12


def solve_from_active_set(
    H: Tensor, f: Tensor, lower: Tensor, upper: Tensor, start: Tensor, tolerance: float, iterations: int = 50
) -> Tensor:
    r"""The minimum of :math:`\tfrac12 x^\top H x + f^\top x` in a box, one problem, by a primal-dual active set.

    Variables of the set are held at their bounds and the others solved for exactly; where
    :math:`x - (Hx + f)/\operatorname{diag} H` lies beyond a bound is the next set. A set that comes again is the
    solution's, and from a start near the solution the first or second does. That happens without any line search, so
    it may also fail to: then ``projected_newton`` takes over. All of it runs on the processor.

    Args:
        H: (N,N), symmetric, positive semidefinite, float64.
        f: (N,).
        lower, upper: (N,), infinite where there is no bound.
        start: in the box, (N,).
        tolerance, iterations: of ``projected_newton``.

    Returns:
        (N,), without gradients.

    Raises:
        ValueRangeError: a bound is NaN or above the other, or ``tolerance`` or ``iterations`` is out of range.

    Source: Hintermüller, Ito and Kunisch 2002, The primal-dual active set strategy as a semismooth Newton method.
    """
    check_box("solve_from_active_set", lower, upper)
    checked_number("solve_from_active_set: tolerance", tolerance)
    checked_count("solve_from_active_set: iterations", iterations)
    H, f = H.detach(), f.detach()
    matrix, slopes, low, high, begin = (np.asarray(part.cpu()) for part in (H, f, lower, upper, start))
    slope = matrix @ begin + slopes
    at_lower, at_upper = (begin <= low) & (slope > 0), (begin >= high) & (slope < 0)
    found = settled_solution(matrix, slopes, matrix.diagonal(), low, high, at_lower, at_upper, _CHANGES)
    if found is not None:
        return torch.from_numpy(found[0]).to(H.device).clamp(lower, upper)
    problem = BoxProblem(H[None], f[None], lower, upper, metric(H[None]))
    return projected_newton(problem, start[None], tolerance, iterations)[0]


def settled_solution(
    H: Array,
    f: Array,
    diagonal: Array,
    lower: Array,
    upper: Array,
    at_lower: Array,
    at_upper: Array,
    changes: int,
) -> tuple[Array, Array] | None:
    r"""The solution x (N,), where the active set settles, and :math:`x - (Hx + f)/\operatorname{diag} H` there.

    NumPy and LAPACK, a call of which takes a fraction of one of torch's.

    Args:
        H: (N,N), symmetric, positive semidefinite, float64.
        f: (N,).
        diagonal: the metric, (N,).
        lower, upper: (N,), infinite where there is no bound.
        at_lower, at_upper: the active set to begin with, (N,) bool.
        changes: at most so many factorisations.
    """
    # Each set follows from the solution of the one before.
    for _ in range(changes):
        free = (~(at_lower | at_upper)).nonzero()[0]
        x = np.where(at_lower, lower, upper)
        x[free] = 0.0
        if len(free):
            rows = H.take(free, 0)
            _, found, failed = dposv(rows.take(free, 1).T, rows @ x + f.take(free), lower=1, overwrite_a=1)
            if failed:
                return None
            x[free] = -found
        aim = x - (H @ x + f) / diagonal
        below, above = aim <= lower, aim >= upper
        above &= ~below
        if below.tobytes() == at_lower.tobytes() and above.tobytes() == at_upper.tobytes():
            return x, aim
        at_lower, at_upper = below, above
    return None
