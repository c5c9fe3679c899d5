r"""One box-constrained quadratic program at a time, of an H that stays: what live solving calls.

From the active set of the frame before, a few factorisations of the free variables end at the optimum
(``warm_active_set``). Where sets do not settle, or there is no frame before, steps of splitting in float32 lead to a
better one. All in NumPy and LAPACK: at 53 variables an operation of theirs takes under a microsecond, one of torch's
several.

With :math:`t = 2 z - v` written out a step of ``operator_splitting`` is one product,
:math:`v' = z (2 G + (2 - \alpha) I) - v G + c`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from torchface.optim.box_problem import metric
from torchface.optim.operator_splitting import SplittingFactors
from torchface.optim.warm_active_set import ActiveSet, Array, ScaledProgram

# Sets tried from the one before, then steps and the sets tried after them; likewise where there is none before.
_WARM_CHANGES = 8
_WARM_ROUNDS: tuple[tuple[int, int], ...] = (20, 4), (40, 4), (60, 12)
_COLD_ROUNDS: tuple[tuple[int, int], ...] = (40, 4), (60, 12)
# Squares beyond which it takes the care of a batch: steep slopes, solutions that may run away.
_STEEPEST, _FARTHEST = 1e30, 1e6


class SingleProgram:
    """H (N,N) and bounds (N,), and what is prepared from them; it remembers the last active set.

    Args:
        H: symmetric, positive semidefinite, float64.
        factors: of its splitting.
        lower, upper: float64.
    """

    def __init__(self, H: Tensor, factors: SplittingFactors, lower: Tensor, upper: Tensor) -> None:
        spread = metric(H).numpy()
        self.scaled = ScaledProgram.of(H.numpy(), spread, lower.numpy(), upper.numpy())
        self.splitting = ScaledSplitting.of(self.scaled, factors)
        self._steepest = _STEEPEST * float(spread.min())
        # Replaced whole, so that threads may share it.
        self._last: ActiveSet | None = None

    def solve(self, f: Array, start: Array | None, tolerance: float) -> Array | None:
        """The minimiser (N,) where it is found to the tolerance on the residual of ``box_qp``.

        Args:
            f: (N,), float64.
            start: such as the frame before, (N,); the solution before if absent.
            tolerance: 0 finds none.
        """
        scaled, last = self.scaled, self._last
        descent = scaled.descent(f)
        # Neither holds for NaN.
        if not (descent @ descent <= self._steepest and (start is None or start @ start <= _FARTHEST)):
            return None
        if start is not None:
            free, at_upper = start > scaled.lower, start >= scaled.upper
            free &= ~at_upper
        elif last is not None:
            free, at_upper = last.free, last.at_upper
        found = None
        if start is not None or last is not None:
            found = scaled.settled(descent, free, at_upper, _WARM_CHANGES, last)
        if found is None:
            found = self._from_afar(descent, start)
        if found is None or not found.error <= tolerance:
            return None
        self._last = found
        x = scaled.unscaled(found)
        return x if x @ x <= _FARTHEST else None

    def _from_afar(self, descent: Array, start: Array | None) -> ActiveSet | None:
        state = self.splitting.started(self.scaled, descent, start)
        for steps, changes in _COLD_ROUNDS if start is None else _WARM_ROUNDS:
            state = self.splitting.steps(descent, state, steps)
            z = state[: len(descent)]
            at_upper = z >= self.splitting.high
            free = (z > self.splitting.low) & ~at_upper
            found = self.scaled.settled(descent, free, at_upper, changes)
            if found is not None:
                return found
        return None


@dataclass(frozen=True, eq=False)
class ScaledSplitting:
    r"""Steps of splitting in the scale of a ``ScaledProgram``, float32 but for the constant.

    Args:
        offset: :math:`\alpha (H + \rho I)^{-1}`, (N,N), float64.
        step: from z and v to the next v, (2N,N).
        rho: :math:`\rho`.
        low, high: (N,).
    """

    offset: Array
    step: Array
    rho: float
    low: Array
    high: Array

    @classmethod
    def of(cls, program: ScaledProgram, factors: SplittingFactors) -> ScaledSplitting:
        scale, share = program.scale, 2 - factors.relaxation
        matrix = factors.step.numpy() * scale[:, None] / scale
        offset = -factors.offset.numpy() / (scale[:, None] * scale)
        single = np.float32
        step = np.concatenate((2 * matrix + share * np.eye(len(scale)), -matrix)).astype(single)
        # G = rho offset - I.
        rho = float((matrix[0, 0] + 1) / offset[0, 0])
        return cls(offset, step, rho, program.low.astype(single), program.high.astype(single))

    def started(self, program: ScaledProgram, descent: Array, start: Array | None) -> Array:
        """z and v (2N,) at ``start`` (N,), unscaled, or at zero."""
        z = np.zeros(len(descent)) if start is None else start / program.scale
        z = np.minimum(np.maximum(z, program.low), program.high)
        v = z
        if start is not None:
            # What is at a bound has the dual variable of its slope, what is free has none.
            slope = z - program.step @ z - descent
            v = np.where((z > program.low) & (z < program.high), z, z - slope / self.rho)
        return np.concatenate((z, v)).astype(np.float32)

    def steps(self, descent: Array, state: Array, count: int) -> Array:
        """z and v (2N,) after some steps."""
        size = len(descent)
        constant = (descent @ self.offset).astype(np.float32)
        following = np.empty_like(state)
        for _ in range(count):  # each needs the one before
            z, v = following[:size], following[size:]
            np.dot(state, self.step, out=v)
            v += constant
            np.maximum(v, self.low, out=z)
            np.minimum(z, self.high, out=z)
            state, following = following, state
        return state
