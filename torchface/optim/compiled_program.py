"""One box-constrained quadratic program at a time by DAQP's compiled dual active set, where its extra is installed.

Source: Arnström, Bemporad and Axehill 2022, A dual active-set solver for embedded quadratic programming.
"""

from __future__ import annotations

from importlib.util import find_spec
from threading import Lock
from typing import Any

import numpy as np

from torchface.optim.warm_active_set import Array

# What DAQP takes for no bound.
_NO_BOUND = 1e30


def compiled_solver_installed() -> bool:
    """Whether the package ``daqp`` is there, which the extra ``live`` installs."""
    return find_spec("daqp") is not None


class CompiledProgram:
    """H (N,N), factored once; each call starts from the active set of the one before.

    Args:
        H: symmetric, positive semidefinite, float64.
        diagonal: its metric, (N,).
    """

    def __init__(self, H: Array, diagonal: Array) -> None:
        self.H, self.diagonal = H, diagonal
        self._model: Any = None
        self._box = b""
        # A model works in memory of its own, and lets other threads run meanwhile.
        self._free = Lock()

    def __reduce__(self) -> tuple[type[CompiledProgram], tuple[Array, Array]]:
        return CompiledProgram, (self.H, self.diagonal)

    def solve(self, f: Array, lower: Array, upper: Array, tolerance: float) -> Array | None:
        """The minimiser (N,) where it is found to the tolerance on the residual of ``box_qp``.

        Args:
            f: (N,), float64.
            lower, upper: (N,), float64.
            tolerance: 0 finds none.
        """
        slope = f @ f
        if not slope <= _NO_BOUND or not self._free.acquire(blocking=False):  # nor is NaN
            return None
        try:
            x = self._minimiser(f, lower, upper)
        finally:
            self._free.release()
        if x is None:
            return None
        x = np.minimum(np.maximum(x, lower), upper)
        step = self.H @ x
        step += f
        step /= self.diagonal
        np.subtract(x, step, out=step)
        np.maximum(step, lower, out=step)
        np.minimum(step, upper, out=step)
        step -= x
        return x if step @ step <= tolerance**2 else None

    def _minimiser(self, f: Array, lower: Array, upper: Array) -> Array | None:
        box = lower.tobytes() + upper.tobytes()
        if box == self._box:
            self._model.update(f=f)
        else:
            import daqp

            size = len(f)
            bounds = (np.clip(bound, -_NO_BOUND, _NO_BOUND) for bound in (upper, lower))
            self._box, self._model = b"", daqp.Model()
            if self._model.setup(self.H, f, np.zeros((0, size)), *bounds, np.zeros(size, np.int32))[0] < 0:
                return None
            self._box = box
        x, _, solved, _ = self._model.solve()
        return x if solved > 0 else None
