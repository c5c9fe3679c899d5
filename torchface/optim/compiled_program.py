"""One box-constrained quadratic program at a time by DAQP's compiled dual active set, where its extra is installed.

Source: Arnström, Bemporad and Axehill 2022, A dual active-set solver for embedded quadratic programming.
"""

from __future__ import annotations

from importlib.util import find_spec
from threading import Lock
from typing import Any

import numpy as np

from torchface.optim.single_program import SingleProgram
from torchface.optim.warm_active_set import Array

# What DAQP takes for no bound.
_NO_BOUND = 1e30


def compiled_solver_installed() -> bool:
    """Whether the package ``daqp`` is there, which the extra ``live`` installs."""
    return find_spec("daqp") is not None


class CompiledProgram:
    """H (N,N), factored once, and bounds (N,); each call starts from the active set of the one before.

    Args:
        H: symmetric, positive semidefinite, float64.
        lower, upper: float64.
        other: what solves where this does not.
    """

    def __init__(self, H: Array, lower: Array, upper: Array, other: SingleProgram) -> None:
        self.H, self.lower, self.upper, self.other = H, lower, upper, other
        self._model: Any = None
        # A model works in memory of its own, and lets other threads run meanwhile.
        self._free = Lock()

    def __reduce__(self) -> tuple[type[CompiledProgram], tuple[Array, Array, Array, SingleProgram]]:
        return CompiledProgram, (self.H, self.lower, self.upper, self.other)

    def solve(self, f: Array, start: Array | None, tolerance: float) -> Array | None:
        """The minimiser (N,) where it is found to the tolerance on the residual of ``box_qp``.

        Args:
            f: (N,), float64.
            start: such as the frame before, (N,), where the other solver has to help.
            tolerance: 0 finds none.
        """
        x = None
        if f @ f <= _NO_BOUND and self._free.acquire(blocking=False):  # nor is NaN
            try:
                x = self._minimiser(f)
            finally:
                self._free.release()
        if x is not None:
            x = np.minimum(np.maximum(x, self.lower), self.upper)
            if self.other.scaled.residual(x, f) <= tolerance:
                return x
        return self.other.solve(f, start, tolerance)

    def _minimiser(self, f: Array) -> Array | None:
        if self._model is None:
            import daqp

            size = len(f)
            bounds = (np.clip(bound, -_NO_BOUND, _NO_BOUND) for bound in (self.upper, self.lower))
            model = daqp.Model()
            if model.setup(self.H, f, np.zeros((0, size)), *bounds, np.zeros(size, np.int32))[0] < 0:
                return None
            self._model = model
        else:
            self._model.update(f=f)
        x, _, solved, _ = self._model.solve()
        return x if solved > 0 else None
