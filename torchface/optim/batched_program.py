"""A batch of box-constrained quadratic programs: splitting finds the active sets, factorisations end it."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.optim.active_set import projected_newton
from torchface.optim.box_checks import check_bounded, check_slope
from torchface.optim.box_problem import BoxProblem
from torchface.optim.operator_splitting import (
    SplittingFactors,
    extrapolated_splitting,
    prepare_splitting,
    splitting_steps,
    start_splitting,
    suited_rho,
)
from torchface.optim.prepared_program import PreparedProgram
from torchface.optim.primal_dual_active_set import primal_dual_active_set

# Cycles of splitting before the active set is tried, times the root of N; then steps of splitting and Newton steps for
# what it does not settle, an H that is singular or close to it: splitting brings such problems near enough for Newton
# steps to end them, and the last ones make sure.
_FIRST_CYCLES = 0.21
# Few variables and a coarse tolerance: so many steps of splitting alone end nearly always, sooner than a factorisation.
_COARSE_ROUNDS = ((None, 88), (None, 40))
_COARSE, _FEW_VARIABLES = 1e-7, 64
_SETTLING_ROUNDS = 4
_LATER_ROUNDS = ((4, 100), (4, 200), (4, 400), (4, 400))
_CAREFUL_ROUNDS = ((8, 400), (8, 800), (8, 1600), (100, 0))
# Numbers in one chunk of frames: three buffers of it stay in a CPU's second-level cache; an accelerator wants more.
_CHUNK_NUMBERS = {"cpu": 2**17, "other": 2**23}


@torch.no_grad()
def solve_in_chunks(program: PreparedProgram, f: Tensor, start: Tensor | None, tolerance: float) -> Tensor:
    """The minimisers (B,N), in as many at once as stay in a cache.

    Args:
        program: H and bounds.
        f: (B,N), finite.
        start: (B,N), finite, or none.
        tolerance: on the residual of ``box_qp``.

    Raises:
        ValueRangeError: f is too steep, or a problem has no minimum.
    """
    lower, upper = program.lower, program.upper
    count, variables = f.shape
    shared = program.H.ndim == 2
    solution = torch.empty_like(f)
    numbers = _CHUNK_NUMBERS.get(f.device.type, _CHUNK_NUMBERS["other"])
    most = max(1, numbers // max(variables if shared else variables**2, 1))
    chunk = -(-count // max(1, -(-count // most)))  # all of about one size: a short last one costs as many calls
    for first in range(0, count, max(1, chunk)):
        rows = slice(first, first + chunk)
        H = program.H if shared else program.H[rows]
        problem = BoxProblem.of(H, f[rows].double(), lower, upper)
        check_slope(problem)
        factors = prepare_splitting(H, suited_rho(H)) if program.factors is None else program.factors
        x = _solve(problem, factors, None if start is None else start[rows].double(), tolerance)
        # Rounding to float32 must not step over a bound.
        solution[rows] = torch.minimum(torch.maximum(x.to(f.dtype), lower.to(f)), upper.to(f))
    return solution


def _solve(problem: BoxProblem, factors: SplittingFactors, start: Tensor | None, tolerance: float) -> Tensor:
    """Splitting finds the active set; it ends most problems, and Newton steps the last of them."""
    cycles = max(1, round(_FIRST_CYCLES * problem.f.shape[1] ** 0.5))
    rounds: tuple[tuple[int | None, int], ...] = ((0, cycles),) * _SETTLING_ROUNDS + _LATER_ROUNDS
    if tolerance >= _COARSE and problem.f.shape[1] <= _FEW_VARIABLES:
        rounds = _COARSE_ROUNDS + rounds
    quick = len(rounds)
    state = start_splitting(problem, start)
    x = state.z.clone()
    rows = torch.arange(len(x), device=x.device)
    part = problem
    for number, (newton_steps, steps) in enumerate((*rounds, *_CAREFUL_ROUNDS)):
        gradient = None
        if number or start is not None:
            if newton_steps:
                found = projected_newton(part, state.z, tolerance, newton_steps, number >= quick)
                gradient = part.gradient(found)
            elif newton_steps is not None:
                found, gradient = primal_dual_active_set(part, state.z)
            else:
                found, gradient = state.z, part.gradient(state.z)
            x[rows] = found
            keep = part.unsolved(found, tolerance, gradient).nonzero()[:, 0]
            if not len(keep):
                break
            gradient = gradient if newton_steps is None else None
            if len(keep) < len(rows):
                rows, part, state, factors = rows[keep], part.rows(keep), state.rows(keep), factors.rows(keep)
                gradient = None if gradient is None else gradient[keep]
        if newton_steps or newton_steps is None:
            dtype = torch.float32 if number < quick else torch.float64
            state = splitting_steps(part, factors, state, steps, gradient, dtype)
        else:
            state = extrapolated_splitting(part, factors, state, steps)
    check_bounded(problem, x)
    return x
