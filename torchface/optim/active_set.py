r"""Active sets of box-constrained quadratic programs, batched: the exact end of a solve.

The primal-dual method holds the variables of a set at their bounds and solves for the others; where
:math:`x - (Hx + f)/\operatorname{diag} H` lies beyond a bound is the next set, and a set that comes again is the
solution's. From a set that is nearly right that takes a factorisation or two a problem. Without line search it need not
settle.

Projected Newton steps always get there: variables at a bound whose gradient pushes outward are held; the others take
the step :math:`-(H_{FF})^{-1} g_F`, clipped to the box at the step length of least objective.

Source: Hintermüller, Ito and Kunisch 2002, The primal-dual active set strategy as a semismooth Newton method; Bertsekas
1982, Projected Newton methods for optimization problems with simple constraints.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.number_checks import checked_count, checked_number
from torchface.optim.box_problem import BoxProblem
from torchface.optim.free_variables import solve_free

_SETS, _STEP_LENGTHS, _BLOCKED_TRIES = 10, 10, 8
# Added to the scaled diagonal (all ones), times the residual: where H is singular the step stays short in directions
# that only rounding fills, and the term fades as fast as the solution comes near.
_DAMPING = 1e-5


def primal_dual_active_set(problem: BoxProblem, start: Tensor) -> tuple[Tensor, Tensor]:
    """The minimisers (B,N) of the problems whose active set, at first that of ``start``, settles, ``start`` of the
    others; and the gradient there."""
    found, slope = start.clone(), problem.gradient(start)
    gradient = slope.clone()
    rows = torch.arange(len(start), device=start.device)
    part, x = problem, start
    at_lower = x <= problem.lower
    at_upper = (x >= problem.upper) & ~at_lower
    before = torch.full_like(rows, start.shape[1] + 1)
    for _ in range(_SETS):
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


def projected_newton(problem: BoxProblem, start: Tensor, tolerance: float, iterations: int = 100) -> Tensor:
    """The minimisers (B,N), from feasible ``start`` (B,N), by steps that always descend.

    A problem whose residual is within the tolerance is left alone.
    """
    checked_number("projected_newton: tolerance", tolerance)
    checked_count("projected_newton: iterations", iterations)
    x = start.clone()
    rows = torch.arange(len(x), device=x.device)
    for _ in range(iterations):
        part, here = problem.rows(rows), x[rows]
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
        if len(stuck):
            x[rows[stuck]] = _careful_step(part.rows(stuck), here[stuck], gradient[stuck], step.rows(stuck))
    return x


@dataclass(frozen=True, eq=False)
class _NewtonStep:
    """A full step and what it was made from."""

    full: Tensor  # where it leads, in the box, (B,N)
    descends: Tensor  # whether the objective falls enough there, (B,)
    held: Tensor  # variables at a bound whose gradient pushes outward, (B,N)
    near: Tensor  # how close to a bound counts as at it, (B,1)
    damping: Tensor  # added to the scaled diagonal, (B,)

    @staticmethod
    def at(problem: BoxProblem, x: Tensor, gradient: Tensor) -> "_NewtonStep":
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

    def rows(self, keep: Tensor) -> "_NewtonStep":
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
