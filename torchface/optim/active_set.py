r"""Projected Newton steps for box-constrained quadratic programs, batched: the exact end of a solve.

Variables at a bound whose gradient pushes outward are held; the others take the Newton step
:math:`-(H_{FF})^{-1} g_F`, clipped to the box at the step length of least objective. Near the solution the held set is
the active set and one Cholesky factorisation a problem ends at rounding error.

Source: Bertsekas 1982, Projected Newton methods for optimization problems with simple constraints.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.number_checks import checked_count, checked_number
from torchface.optim.box_problem import BoxProblem
from torchface.optim.free_variables import solve_free

# Numbers in the matrices factored at once: 2 MB of float64 stay in a CPU's cache; an accelerator wants more.
_CHUNK_NUMBERS = {"cpu": 2**18, "other": 2**25}
_STEP_LENGTHS, _BLOCKED_TRIES = 10, 8
# Added to the scaled diagonal (all ones), times the residual: where H is singular the step stays short in directions
# that only rounding fills, and the term fades as fast as the solution comes near.
_DAMPING = 1e-5


def projected_newton(
    problem: BoxProblem, start: Tensor, tolerance: float, iterations: int = 100, careful: bool = True
) -> Tensor:
    """The minimisers (B,N), from feasible ``start`` (B,N).

    Args:
        problem: B problems, float64.
        start: feasible points, (B,N).
        tolerance: on ``problem.residual``; a problem that reaches it is left alone.
        iterations: at most so many steps.
        careful: search where the full step does not descend, and so descend always; otherwise leave such a problem
            where it stands, too far from its solution for Newton steps to be worth their cost.

    Raises:
        ValueRangeError: ``tolerance`` or ``iterations`` is negative or no number.
    """
    checked_number("projected_newton: tolerance", tolerance)
    checked_count("projected_newton: iterations", iterations)
    numbers = _CHUNK_NUMBERS.get(start.device.type, _CHUNK_NUMBERS["other"])
    chunk = max(1, numbers // problem.f.shape[1] ** 2)
    x = start.clone()
    for first in range(0, len(x), chunk):
        rows = torch.arange(first, min(first + chunk, len(x)), device=x.device)
        for _ in range(iterations):
            part = problem.rows(rows)
            here = x[rows]
            gradient = part.gradient(here)
            open_ = part.unsolved(here, tolerance, gradient)
            if not bool(open_.all()):
                rows, here, gradient = rows[open_], here[open_], gradient[open_]
                part = problem.rows(rows)
            if not len(rows):
                break
            step = _NewtonStep.at(part, here, gradient)
            x[rows] = torch.where(step.descends[:, None], step.full, here)
            stuck = (~step.descends).nonzero()[:, 0]
            if not len(stuck):
                continue
            if careful:
                x[rows[stuck]] = _careful_step(part.rows(stuck), here[stuck], gradient[stuck], step.rows(stuck))
            else:
                rows = rows[step.descends]
    return x


@dataclass(frozen=True, eq=False)
class _NewtonStep:
    """A full step and what it was made from.

    Args:
        full: where it leads, in the box, (B,N).
        descends: whether the objective falls enough there, (B,).
        held: variables at a bound whose gradient pushes outward, (B,N).
        near: how close to a bound counts as at it, (B,1).
        damping: added to the scaled diagonal, (B,).
    """

    full: Tensor
    descends: Tensor
    held: Tensor
    near: Tensor
    damping: Tensor

    @staticmethod
    def at(problem: BoxProblem, x: Tensor, gradient: Tensor) -> _NewtonStep:
        residual = problem.residual(x, gradient)
        # A variable closer to its bound than the residual counts as at it, else the search path could collapse.
        near = residual.clamp(max=1e-3)[:, None]
        held = ((x - problem.lower <= near) & (gradient > 0)) | ((problem.upper - x <= near) & (gradient < 0))
        damping = _DAMPING * residual.clamp(max=1)
        newton = solve_free(problem.H, problem.diagonal, ~held, -gradient, damping)
        full = problem.clip(x + torch.where(held, -gradient / problem.diagonal, newton))
        moved = full - x
        descends = problem.change(moved, gradient) <= 0.1 * (gradient * moved).sum(-1)
        return _NewtonStep(full, descends, held, near, damping)

    def rows(self, keep: Tensor) -> _NewtonStep:
        return _NewtonStep(self.full[keep], self.descends[keep], self.held[keep], self.near[keep], self.damping[keep])


def _careful_step(problem: BoxProblem, x: Tensor, gradient: Tensor, step: _NewtonStep) -> Tensor:
    """A step that a bound at hand cannot stop: what the direction would push out is held too, and solved again."""
    held, damping = step.held, step.damping
    at_lower, at_upper = x - problem.lower <= step.near, problem.upper - x <= step.near
    direction = solve_free(problem.H, problem.diagonal, ~held, -gradient, damping)
    for _ in range(_BLOCKED_TRIES):
        blocked = ~held & ((at_lower & (direction < 0)) | (at_upper & (direction > 0)))
        some = blocked.any(-1)
        if not bool(some.any()):
            break
        held = held | blocked
        part = problem.rows(some)
        direction[some] = solve_free(part.H, part.diagonal, ~held[some], -gradient[some], damping[some])
    room = torch.where(direction < 0, x - problem.lower, problem.upper - x)
    reach = torch.where(direction == 0, torch.inf, room / direction.abs()).amin(-1, keepdim=True).clamp(max=1)
    direction = torch.where(held, -gradient / problem.diagonal, direction)
    # The best of the way to the first bound, of halved steps bent along the box, and of a step that always descends.
    trials = [x + reach * direction, *(x + 0.5**halvings * direction for halvings in range(_STEP_LENGTHS))]
    best = problem.clip(x - gradient / problem.diagonal / len(problem.lower))
    least = problem.change(best - x, gradient)
    for trial in trials:
        trial = problem.clip(trial)
        change = problem.change(trial - x, gradient)
        better = change < least
        best = torch.where(better[:, None], trial, best)
        least = torch.where(better, change, least)
    return best
