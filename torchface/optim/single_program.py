r"""One box-constrained quadratic program at a time, of an H that stays: what live solving calls.

From the active set of the frame before a few factorisations of the free variables end at the optimum nearly always
(``warm_active_set``); where they do not, or without such a frame, some steps of splitting in float32 come first. All in
NumPy and LAPACK: at 53 variables an operation of theirs takes under a microsecond, one of torch's several.

With :math:`t = 2 z - v` written out a step of ``operator_splitting`` is one product,
:math:`v' = z (2 G + (2 - \alpha) I) - v G + c`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchface.optim.box_problem import metric
from torchface.optim.operator_splitting import SplittingFactors
from torchface.optim.warm_active_set import Array, settled_solution

# Factorisations from the active set of the frame before.
_NEXT_CHANGES = 6
# Steps before each try for the active set, and factorisations of a try: one from a strange start is given up early.
_WARM_ROUNDS: tuple[tuple[int, int], ...] = (12, 4), (30, 3), (60, 12)
_COLD_ROUNDS: tuple[tuple[int, int], ...] = (40, 4), (60, 12)
# Squares beyond which it takes the care of a batch: steep slopes, solutions that may run away.
_STEEPEST, _FARTHEST = 1e30, 1e6


@dataclass(frozen=True, eq=False)
class SingleProgram:
    """H (N,N) and what is prepared from it.

    Args:
        H: symmetric, positive semidefinite, float64.
        diagonal: its metric, (N,).
        offset: :math:`-\\alpha (H + \\rho D)^{-1}`, (N,N).
        step: from z and v to the next v, (2N,N), float32.
        dual: :math:`1 / \\rho D`, (N,).
    """

    H: Array
    diagonal: Array
    offset: Array
    step: Array
    dual: Array

    @staticmethod
    def of(H: Tensor, factors: SplittingFactors) -> SingleProgram:
        matrix = factors.step
        twice = 2 * matrix + (2 - factors.relaxation) * torch.eye(len(H), dtype=H.dtype)
        diagonal = metric(H)
        # G = -offset rho D - I.
        lift = (matrix.diagonal() + 1) / -factors.offset.diagonal()
        step = torch.cat((twice, -matrix)).float()
        return SingleProgram(*(part.numpy() for part in (H, diagonal, factors.offset, step, 1 / lift)))

    def solve(self, f: Array, lower: Array, upper: Array, start: Array | None, tolerance: float) -> Array | None:
        """The minimiser (N,) where it is found to the tolerance on the residual of ``box_qp``.

        Args:
            f: (N,), float64.
            lower, upper: (N,), float64.
            start: such as the frame before, (N,), if there is one.
            tolerance: 0 finds none.
        """
        steepness = f / self.diagonal
        # Neither holds for NaN.
        if not (steepness @ steepness <= _STEEPEST and (start is None or start @ start <= _FARTHEST)):
            return None
        if start is None:
            z = v = np.minimum(np.maximum(0.0, lower), upper)
            rounds = _COLD_ROUNDS
        else:
            z = np.minimum(np.maximum(start, lower), upper)
            at_lower, at_upper = z <= lower, (z >= upper) & (upper > lower)
            found = settled_solution(self.H, f, self.diagonal, lower, upper, at_lower, at_upper, _NEXT_CHANGES)
            if found is not None and (x := _checked(*found, lower, upper, tolerance)) is not None:
                return x
            # What is at a bound has the dual variable of its slope, what is free has none.
            v = np.where((z > lower) & (z < upper), z, z - self.dual * (self.H @ z + f))
            rounds = _WARM_ROUNDS
        size = len(f)
        single = np.float32
        low, high, constant = lower.astype(single), upper.astype(single), (f @ self.offset).astype(single)
        state, following = np.concatenate((z, v)).astype(single), np.empty(2 * size, single)
        for steps, changes in rounds:
            for _ in range(steps):  # each needs the one before
                clipped, v = following[:size], following[size:]
                np.dot(state, self.step, out=v)
                v += constant
                np.maximum(v, low, out=clipped)
                np.minimum(clipped, high, out=clipped)
                state, following = following, state
            z = state[:size]
            at_lower = z <= low
            at_upper = (z >= high) & ~at_lower
            found = settled_solution(self.H, f, self.diagonal, lower, upper, at_lower, at_upper, changes)
            if found is not None:
                return _checked(*found, lower, upper, tolerance)
        return None


def _checked(x: Array, aim: Array, lower: Array, upper: Array, tolerance: float) -> Array | None:
    left = np.abs(np.minimum(np.maximum(aim, lower), upper) - x).max()
    return x if left <= tolerance and x @ x <= _FARTHEST else None
