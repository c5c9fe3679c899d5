"""A box-constrained quadratic program from a start whose active set is all but right: a factorisation or two."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.number_checks import checked_count, checked_number
from torchface.optim.active_set import projected_newton
from torchface.optim.box_problem import BoxProblem, check_box, metric

_CHANGES = 12


def solve_from_active_set(
    H: Tensor, f: Tensor, lower: Tensor, upper: Tensor, start: Tensor, tolerance: float, iterations: int = 50
) -> Tensor:
    r"""The minimum of :math:`\tfrac12 x^\top H x + f^\top x` in a box, one problem, by a primal-dual active set.

    Variables of the set are held at their bounds and the others solved for exactly; where
    :math:`x - (Hx + f)/\operatorname{diag} H` lies beyond a bound is the next set. A set that comes again is the
    solution's, and from a start near the solution the first or second does. That happens without any line search, so
    it may also fail to: then ``projected_newton`` takes over.

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
    slope = torch.addmv(f, H, start)
    at_lower, at_upper = (start <= lower) & (slope > 0), (start >= upper) & (slope < 0)
    diagonal = H.diagonal()
    # Each set follows from the solution of the one before.
    for _ in range(_CHANGES):
        held = at_lower | at_upper
        bound = torch.where(at_lower, lower, torch.where(at_upper, upper, 0.0))
        reduced = H.masked_fill(held, 0.0).masked_fill_(held[:, None], 0.0)
        reduced.diagonal().add_(held)
        factor, failed = torch.linalg.cholesky_ex(reduced)
        if failed:
            break
        right = torch.where(held, bound, torch.addmv(f, H, bound).neg_())
        x = torch.cholesky_solve(right[:, None], factor)[:, 0]
        aim = torch.addcdiv(x, torch.addmv(f, H, x), diagonal, value=-1)
        below, above = aim < lower, aim > upper
        if torch.equal(below, at_lower) and torch.equal(above, at_upper):
            return x.clamp(lower, upper)
        at_lower, at_upper = below, above
    problem = BoxProblem(H[None], f[None], lower, upper, metric(H[None]))
    return projected_newton(problem, start[None], tolerance, iterations)[0]
