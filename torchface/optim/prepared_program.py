"""Values of box-constrained quadratic programs of one H and bounds, prepared once for many calls."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchface.optim.box_checks import checked_bounds, checked_hessian
from torchface.optim.compiled_program import CompiledProgram, compiled_solver_installed
from torchface.optim.operator_splitting import SplittingFactors, prepare_splitting, suited_rho
from torchface.optim.single_program import SingleProgram

# So many problems are solved one by one.
_FEW = 8
# Variables beyond which NumPy and LAPACK are the quicker ones.
_COMPILED_VARIABLES = 80


@dataclass(frozen=True, eq=False)
class PreparedProgram:
    """The symmetric part of H in float64, bounds in float64, and the factors of one H for all problems.

    Args:
        H: (N,N) or (B,N,N).
        lower, upper: (N,).
        factors: of one H for all problems, none where each has its own.
    """

    H: Tensor
    lower: Tensor
    upper: Tensor
    factors: SplittingFactors | None

    @classmethod
    @torch.no_grad()
    def of(cls, H: Tensor, lower: float | Tensor, upper: float | Tensor) -> PreparedProgram:
        """Checks H and bounds, numbers or (N,).

        Raises:
            ShapeError, ValueRangeError: as ``box_qp`` says.
        """
        exact = checked_hessian(H)
        factors = prepare_splitting(exact, suited_rho(exact)) if exact.ndim == 2 else None
        return cls(exact, *checked_bounds(lower, upper, exact), factors)

    @cached_property
    def single(self) -> SingleProgram | CompiledProgram | None:
        """For calls of few problems; on an accelerator, or with an H for each problem, there is none."""
        if self.factors is None or self.H.device.type != "cpu":
            return None
        single = SingleProgram(self.H, self.factors, self.lower, self.upper)
        if len(self.H) > _COMPILED_VARIABLES or not compiled_solver_installed():
            return single
        return CompiledProgram(self.H.numpy(), self.lower.numpy(), self.upper.numpy(), single)

    @cached_property
    def _rounded_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.lower.float().numpy(), self.upper.float().numpy()

    def solved_singly(self, f: Tensor, start: Tensor | None, tolerance: float) -> Tensor | None:
        """The minimisers (B,N) of few problems, one by one, where each is found.

        What is not as it should be is left to the checks of a batch.

        Args:
            f: of H's dtype, without gradients.
            start: as in ``box_qp``.
            tolerance: as in ``box_qp``.
        """
        program = self.single
        if program is None or f.ndim != 2 or not 0 < len(f) <= _FEW or f.shape[1] != len(self.H) or not f.is_cpu:
            return None
        if start is not None and (start.shape != f.shape or not start.is_cpu):
            return None
        slopes = f.detach().numpy().astype(np.float64, copy=False)
        starts = None if start is None else start.detach().numpy().astype(np.float64, copy=False)
        found = np.empty(slopes.shape)
        for row, slope in enumerate(slopes):  # a batch of few takes as long as a dozen of these
            x = program.solve(slope, None if starts is None else starts[row], tolerance)
            if x is None:
                return None
            found[row] = x
        if f.dtype == torch.float32:
            # Rounding must not step over a bound.
            lower, upper = self._rounded_bounds
            found = np.minimum(np.maximum(found.astype(np.float32), lower), upper)
        return torch.from_numpy(found)
