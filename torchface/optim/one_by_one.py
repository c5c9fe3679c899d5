"""Box-constrained quadratic programs one at a time by DAQP, a compiled dual active set: for few problems at once.

Source: Arnström, Bemporad and Axehill 2022, A dual active-set solver for embedded quadratic programming.
"""

from __future__ import annotations

from threading import Lock
from typing import TypeAlias

import daqp
import numpy as np
from torch import Tensor

from torchface.optim.box_problem import metric

Array: TypeAlias = "np.ndarray"

# What DAQP takes for no bound, and squared slopes beyond which its objective would overflow.
_NO_BOUND, _STEEPEST = 1e30, 1e30
# How far a variable may leave its bounds, in the scale in which the diagonal of H is one.
_PRIMAL_TOLERANCE = 1e-9
_ROUNDING = 1e-12
_NONE = np.zeros(0, np.int64)


class OneByOne:
    r"""Problems of one H, factored once, or of an H each; each starts from the active set of the one before.

    The first of several starts from none, so that the same call gives the same bits.

    Args:
        H: (N,N) or (B,N,N), symmetric, positive semidefinite, float64, on the processor.
        lower, upper: (N,), float64, infinite where there is no bound.
    """

    def __init__(self, H: Tensor, lower: Tensor, upper: Tensor) -> None:
        self._given = H, lower, upper
        # In the scale of a unit diagonal one tolerance suits all variables.
        self._scale = scale = metric(H).rsqrt().numpy()
        self._H = H.numpy() * scale[..., :, None] * scale[..., None, :]
        self._step = np.eye(H.shape[-1]) - self._H
        self._low, self._high = (np.clip(bound.numpy() / scale, -_NO_BOUND, _NO_BOUND) for bound in (lower, upper))
        self._lower, self._upper = lower.numpy(), upper.numpy()
        self._near_low = self._low + _ROUNDING * (1 + np.abs(self._low))
        self._near_high = self._high - _ROUNDING * (1 + np.abs(self._high))
        self._model: daqp.Model | None = None
        # A model works in memory of its own, and lets other threads run meanwhile.
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[OneByOne], tuple[Tensor, Tensor, Tensor]]:
        return OneByOne, self._given

    def solve(self, f: Array, tolerance: float) -> tuple[Array, Array]:
        """The minimisers (B,N), in the bounds, and rows of those not solved to ``box_qp``'s tolerance."""
        slopes = f * self._scale
        y = np.empty_like(slopes)
        with self._lock:
            for row, slope in enumerate(slopes):
                y[row] = self._minimiser(row, slope, cold=row == 0 and len(slopes) > 1)
        x = y * self._scale
        # What is at a bound is there exactly, or it would count as free.
        at_low, at_high = y <= self._near_low, y >= self._near_high
        np.copyto(x, self._lower, where=at_low)
        np.copyto(x, self._upper, where=at_high)
        aim = y @ self._step if self._step.ndim == 2 else (self._step @ y[..., None])[..., 0]
        aim -= slopes
        np.maximum(aim, self._low, out=aim)
        np.minimum(aim, self._high, out=aim)
        aim -= y
        aim *= self._scale
        np.abs(aim, out=aim)
        # Most end here: of one frame each call of NumPy counts. Nothing holds for NaN, where the solver found nothing.
        if aim.max(initial=0.0) <= tolerance:
            return x, _NONE
        return x, (~(aim <= tolerance * (1 + np.abs(x))).all(1)).nonzero()[0]

    def _minimiser(self, row: int, slope: Array, cold: bool) -> Array | float:
        """Of a problem, scaled; NaN where there is none to be found."""
        if not slope @ slope <= _STEEPEST:  # nor is NaN
            return np.nan
        shared = self._H.ndim == 2
        H, low, high = (part if shared else part[row] for part in (self._H, self._low, self._high))
        before = self._model
        model = self._model = before or _set_up(H, low, high)
        if model is None:
            return np.nan
        sense = np.zeros(len(slope), np.int32) if cold else None
        if shared or before is None:
            model.update(f=slope, sense=sense)
        else:
            model.update(H=H, f=slope, bupper=high, blower=low, sense=sense)
        y, _, solved, _ = model.solve()
        return y if solved > 0 else np.nan


def _set_up(H: Array, low: Array, high: Array) -> daqp.Model | None:
    size = len(H)
    model = daqp.Model()
    if model.setup(H, np.zeros(size), np.zeros((0, size)), high, low, np.zeros(size, np.int32))[0] < 0:
        return None
    model.settings = {**model.settings, "primal_tol": _PRIMAL_TOLERANCE}
    return model
