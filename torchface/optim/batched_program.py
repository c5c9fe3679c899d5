"""A batch of box-constrained quadratic programs in three phases, each for what the one before has left.

1. Splitting, in float32: matrix products and clamps for all problems at once.
2. Active sets: from those that splitting found a factorisation or two a problem end at the optimum.
3. Newton steps with a search, after more of splitting in float64: for an H that is singular or close to it.
"""

import math

import torch
from torch import Tensor

from torchface.optim.active_set import primal_dual_active_set, projected_newton
from torchface.optim.box_problem import BoxProblem
from torchface.optim.operator_splitting import (
    SplittingFactors,
    prepare_splitting,
    splitting_steps,
    start_splitting,
    suited_rho,
)

# Few variables and a coarse tolerance: splitting alone ends nearly always, sooner than a factorisation. So many steps
# for a tolerance of 1e-4, for each decade below it, and for what these leave.
_COARSE, _FEW_VARIABLES = 1e-7, 64
_STEPS, _STEPS_A_DECADE, _MORE_STEPS = 55, 18, 40
# Otherwise so many steps, times the root of N, before active sets are tried; twice as many each time that both are.
_STEPS_A_ROOT, _MOST_STEPS, _SETTLING_ROUNDS = 4, 75, 5
# With an H each: rounds of so many steps with the mean H, and the residual from which active sets seldom settle.
_ROUNDS, _STEPS_A_ROUND, _NEAR = 8, 5, 0.2
# Steps of splitting and of Newton. The last ones make sure.
_CAREFUL_ROUNDS = ((60, 8), (400, 8), (800, 8), (1600, 8), (0, 100))


def solve_batch(
    problem: BoxProblem, factors: SplittingFactors | None, start: Tensor | None, tolerance: float
) -> Tensor:
    """The minimisers (B,N), or the last steps that do not reach them; factors of several H are made here, as far as
    needed."""
    left = _Unsolved(problem, factors, start, tolerance)
    if start is not None and left.without(left.state.z):
        return left.x
    for phase in (_split, _settle, _descend):
        if phase(left):
            break
    return left.x


def solve_alike(problem: BoxProblem, start: Tensor | None, tolerance: float) -> tuple[Tensor, Tensor]:
    """The minimisers (B,N) of problems with an H each that are much alike, and which of them this solves, (B,) bool.

    Splitting with the mean H, which begins anew every few steps from each problem's own gradient, factors nothing a
    problem and comes near enough for active sets.
    """
    mean = problem.H.mean(0)
    factors, state = prepare_splitting(mean, suited_rho(mean)), start_splitting(problem, start)
    for _ in range(_ROUNDS):
        state = splitting_steps(problem, factors, state, _STEPS_A_ROUND, torch.float32)
    x, solved = state.z, problem.residual(state.z) < _NEAR  # NaN, where H are too little alike, is not
    part = problem.rows(solved)
    x[solved], gradient = primal_dual_active_set(part, x[solved])
    solved[solved.clone()] = ~part.unsolved(x[solved], tolerance, gradient)
    return x, solved


class _Unsolved:
    """Problems of a batch that are not solved yet, where splitting stands in them, and the solutions of all."""

    def __init__(
        self, problem: BoxProblem, factors: SplittingFactors | None, start: Tensor | None, tolerance: float
    ) -> None:
        self.problem, self.tolerance = problem, tolerance
        self._factors = factors
        self.state = start_splitting(problem, start)
        self.x = self.state.z
        self._rows = torch.arange(len(self.x), device=self.x.device)

    @property
    def factors(self) -> SplittingFactors:
        if self._factors is None:
            self._factors = prepare_splitting(self.problem.H, suited_rho(self.problem.H))
        return self._factors

    def without(self, found: Tensor, gradient: Tensor | None = None) -> bool:
        """Takes what was found, and the gradient there, and leaves out what it solves; whether that is all."""
        if len(self._rows) == len(self.x):
            self.x = found
        else:
            self.x[self._rows] = found
        keep = self.problem.unsolved(found, self.tolerance, gradient).nonzero()[:, 0]
        if len(keep) < len(self._rows):
            self._rows, self.problem = self._rows[keep], self.problem.rows(keep)
            self.state = self.state.rows(keep)
            self._factors = None if self._factors is None else self._factors.rows(keep)
        return not len(keep)


def _split(left: _Unsolved) -> bool:
    if left.tolerance < _COARSE or left.x.shape[1] > _FEW_VARIABLES:
        return False
    more = max(0.0, _STEPS_A_DECADE * math.log10(1e-4 / left.tolerance))
    for steps in (_STEPS + round(more), _MORE_STEPS):
        left.state = splitting_steps(left.problem, left.factors, left.state, steps, torch.float32)
        if left.without(left.state.z):
            return True
    return left.without(*primal_dual_active_set(left.problem, left.state.z))


def _settle(left: _Unsolved) -> bool:
    steps = min(_MOST_STEPS, round(_STEPS_A_ROOT * left.x.shape[1] ** 0.5))
    for doublings in range(_SETTLING_ROUNDS):  # ever fewer problems are left
        left.state = splitting_steps(left.problem, left.factors, left.state, steps << doublings, torch.float32)
        if left.without(*primal_dual_active_set(left.problem, left.state.z)):
            return True
    return False


def _descend(left: _Unsolved) -> bool:
    for splitting, newton in _CAREFUL_ROUNDS:
        left.state = splitting_steps(left.problem, left.factors, left.state, splitting)
        if left.without(projected_newton(left.problem, left.state.z, left.tolerance, newton)):
            return True
    return False
