r"""The primal-dual active set method for many box-constrained quadratic programs: the exact end of a splitting.

Variables of the active set are held at their bounds and the others solved for exactly; where
:math:`x - (Hx + f)/\operatorname{diag} H` lies beyond a bound is the next set. A set that comes again is the
solution's. From an active set that is nearly right that takes a factorisation or two of the free variables alone, and
without line search it need not happen: a problem whose set stops settling is given back.

Source: Hintermüller, Ito and Kunisch 2002, The primal-dual active set strategy as a semismooth Newton method.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.number_checks import checked_count
from torchface.optim.box_problem import BoxProblem
from torchface.optim.free_variables import solve_free


def primal_dual_active_set(problem: BoxProblem, start: Tensor, iterations: int = 10) -> tuple[Tensor, Tensor]:
    """The minimisers (B,N) of the problems whose active set settles, ``start`` of the others, and the gradient there.

    Args:
        problem: B problems, float64.
        start: in the box, (B,N); its variables at a bound are the first active set.
        iterations: at most so many factorisations.

    Raises:
        ValueRangeError: ``iterations`` is negative or no whole number.
    """
    checked_count("primal_dual_active_set: iterations", iterations)
    found, slope = start.clone(), problem.gradient(start)
    gradient = slope.clone()
    rows = torch.arange(len(start), device=start.device)
    part, x = problem, start
    at_lower = x <= problem.lower
    at_upper = (x >= problem.upper) & ~at_lower
    before = torch.full_like(rows, start.shape[1] + 1)
    for _ in range(iterations):
        free = ~(at_lower | at_upper)
        x = x + solve_free(part.H, part.diagonal, free, -slope)
        slope = part.gradient(x)
        aim = torch.where(free, x, torch.addcdiv(x, slope, part.diagonal, value=-1))
        below = aim <= part.lower
        above = (aim >= part.upper) & ~below
        changes = ((below != at_lower) | (above != at_upper)).sum(-1)
        settled = changes == 0
        found[rows[settled]], gradient[rows[settled]] = x[settled], slope[settled]
        # Sets that change more from one to the next run in circles nearly always.
        keep = ((changes > 0) & (changes < before)).nonzero()[:, 0]
        if not len(keep):
            break
        rows, part, before = rows[keep], part.rows(keep), changes[keep]
        at_lower, at_upper = below[keep], above[keep]
        x = torch.where(at_lower, part.lower, torch.where(at_upper, part.upper, x[keep]))
        slope = part.gradient(x)
    return found, gradient
