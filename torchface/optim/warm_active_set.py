r"""A box-constrained quadratic program from a start whose active set is nearly right: a few small factorisations.

All in NumPy and LAPACK, whose calls take a fraction of one of torch's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from scipy.linalg.lapack import dposv, dpotrs
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

    From a start near the solution a few sets lead to the solution's (``ScaledProgram``). Where they do not,
    ``projected_newton`` takes over. All of it runs on the processor.

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
    matrix, slopes, low, high, begin, spread = (
        np.asarray(part.cpu()) for part in (H, f, lower, upper, start, metric(H))
    )
    program = ScaledProgram.of(matrix, spread, low, high)
    slope = matrix @ begin + slopes
    at_lower, at_upper = (begin <= low) & (slope > 0), (begin >= high) & (slope < 0)
    found = program.settled(program.descent(slopes), ~(at_lower | at_upper), at_upper, _CHANGES)
    if found is not None:
        return torch.from_numpy(program.unscaled(found)).to(H.device)
    problem = BoxProblem(H[None], f[None], lower, upper, metric(H[None]))
    return projected_newton(problem, start[None], tolerance, iterations)[0]


@dataclass(frozen=True, eq=False)
class ActiveSet:
    r"""The set of a solution, what its free variables were factored to, and the scaled solution.

    Args:
        free, at_upper: (N,) bool; the other variables are at their lower bound.
        factor: of the block of the free variables, as ``dpotrf`` leaves it.
        x: (N,), scaled.
        error: by how much :math:`x - (Hx + f)/\operatorname{diag} H` misses a free variable, at most.
    """

    free: Array
    at_upper: Array
    factor: Array | None
    x: Array
    error: float


@dataclass(frozen=True, eq=False)
class ScaledProgram:
    r"""H and bounds in the scale in which the diagonal is one, :math:`x = D^{-1/2} y`.

    Args:
        H: :math:`D^{-1/2} H D^{-1/2}`, (N,N), symmetric, positive semidefinite, float64.
        step: :math:`I - H`: :math:`y - (Hy + f)` lies beyond a bound where that holds at the solution, (N,N).
        scale: :math:`D^{-1/2}`, (N,).
        low, high: the scaled bounds, (N,), infinite where there is none.
        lower, upper: the bounds themselves.
    """

    H: Array
    step: Array
    scale: Array
    low: Array
    high: Array
    lower: Array
    upper: Array

    @classmethod
    def of(cls, H: Array, spread: Array, lower: Array, upper: Array) -> ScaledProgram:
        """From H (N,N), its metric (N,) and bounds (N,)."""
        root = np.sqrt(spread)
        scale = 1 / root
        scaled = H * scale
        scaled *= scale[:, None]
        return cls(scaled, np.eye(len(H)) - scaled, scale, lower * root, upper * root, lower, upper)

    def descent(self, f: Array) -> Array:
        """The scaled :math:`-f`, (N,)."""
        scaled: Array = f * self.scale
        return np.negative(scaled, out=scaled)

    def residual(self, x: Array, f: Array) -> float:
        """The largest of :math:`|x - clip(x - (Hx + f)/\\operatorname{diag} H)|`, for x (N,) in the box."""
        aim = self.step @ (x / self.scale)
        aim -= f * self.scale
        aim *= self.scale
        np.maximum(aim, self.lower, out=aim)
        np.minimum(aim, self.upper, out=aim)
        aim -= x
        return float(np.abs(aim).max())

    def unscaled(self, found: ActiveSet) -> Array:
        """The solution (N,), at its bounds exactly."""
        x = found.x * self.scale
        np.maximum(x, self.lower, out=x)
        np.minimum(x, self.upper, out=x)
        if found.at_upper.any():
            x[found.at_upper] = self.upper[found.at_upper]
        return x

    def settled(
        self, descent: Array, free: Array, at_upper: Array, changes: int, before: ActiveSet | None = None
    ) -> ActiveSet | None:
        r"""The solution's active set, where sets settle.

        Variables of a set are held at their bounds and the others solved for exactly; where :math:`y - (Hy + f)` lies
        beyond a bound is the next set. A set that comes again is the solution's. Without any line search it need not
        come.

        Args:
            descent: scaled :math:`-f`, (N,).
            free, at_upper: the set to begin with, (N,) bool.
            changes: at most so many sets.
            before: a solution whose factor serves where the set is its set.
        """
        low, high, step = self.low, self.high, self.step
        factor = None if before is None or free.tobytes() != before.free.tobytes() else before.factor
        for _ in range(changes):  # each set follows from the solution of the one before
            ids = free.nonzero()[0]
            x = np.where(at_upper, high, low)
            x[ids] = 0.0
            side = (descent + step @ x).take(ids) if x.any() else descent.take(ids)
            if factor is not None:
                solution, failed = dpotrs(factor, side, lower=1)
            elif len(ids):
                factor, solution, failed = dposv(self.H.take(ids, 0).take(ids, 1).T, side, lower=1, overwrite_a=1)
            else:
                solution, failed = side, 0
            if failed:
                return None
            x[ids] = solution
            aim = step @ x
            aim += descent
            above = aim >= high
            inside = aim > low
            above &= inside
            inside &= ~above
            if inside.tobytes() == free.tobytes() and above.tobytes() == at_upper.tobytes():
                error = aim.take(ids)
                error -= solution
                error *= self.scale.take(ids)
                return ActiveSet(free, at_upper, factor, x, float(np.abs(error).max(initial=0.0)))
            free, at_upper, factor = inside, above, None
        return None
