"""Box-constrained quadratic programs prepared once for many calls, and the choice of their solver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchface.optim.batched_program import solve_batch
from torchface.optim.box_checks import check_bounded, check_finite, check_slope, checked_bounds, checked_hessian
from torchface.optim.box_problem import BoxProblem
from torchface.optim.one_by_one import Array, OneByOne
from torchface.optim.operator_splitting import SplittingFactors, prepare_two_stages

# Measured on 16 to 600 variables: DAQP is the faster one for up to so many problems of one H, each of which takes it a
# time that grows as variables cubed and a constant; with an H each for up to so many variables, however many problems.
_FEW, _CONSTANT, _FEW_VARIABLES = 230**3, 40**3, 80
# Numbers in one chunk of problems with an H each, twice those of one H, but so many frames at least: more take a fifth
# longer where other work fills the third-level cache; an accelerator wants more.
_CHUNK_NUMBERS, _LEAST_FRAMES = {"cpu": 2**17, "other": 2**23}, 256


@dataclass(frozen=True, eq=False)
class PreparedProgram:
    """The symmetric part of H in float64, and bounds in float64."""

    H: Tensor  # (N,N) for all problems or (B,N,N)
    # lower, upper: (N,), infinite where there is no bound
    lower: Tensor
    upper: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, H: Tensor, lower: float | Tensor, upper: float | Tensor) -> PreparedProgram:
        """Checks H and bounds, numbers or (N,)."""
        exact = checked_hessian(H)
        return cls(exact, *checked_bounds(lower, upper, exact))

    def solve(self, f: Tensor, start: Tensor | None, tolerance: float) -> Tensor:
        """The minimisers (B,N) in the dtype of f: of few problems by DAQP, of many, and what it leaves, as batches."""
        if len(f) <= self._few:
            x = self._solve_few(f.detach().numpy(), tolerance)
        else:
            check_finite(f, start)
            x = self._in_chunks(f.detach().double(), None if start is None else start.detach().double(), tolerance)
        if f.dtype == torch.float64:
            return x
        # Rounding must not step over a bound.
        return x.to(f.dtype).clamp_(self.lower.to(f), self.upper.to(f))

    def _solve_few(self, f: Array, tolerance: float) -> Tensor:
        f = f.astype(np.float64, copy=False)
        x, open_ = self._one_by_one.solve(f, tolerance)
        found = torch.from_numpy(x)
        if len(open_):
            rows, slopes = torch.from_numpy(open_), torch.from_numpy(f[open_])
            check_finite(torch.from_numpy(f), None)
            found[rows] = self._rows(rows)._in_chunks(slopes, found[rows].nan_to_num(0.0), tolerance)
        return found

    @cached_property
    def _few(self) -> float:
        """So many problems at most are solved one by one."""
        size = len(self.lower)
        if self.H.device.type != "cpu" or (self.H.ndim == 3 and size > _FEW_VARIABLES):
            return -1
        return _FEW / (size**3 + _CONSTANT) if self.H.ndim == 2 else math.inf

    @cached_property
    def _one_by_one(self) -> OneByOne:
        return OneByOne(self.H, self.lower, self.upper)

    @cached_property
    def _factors(self) -> SplittingFactors:
        return prepare_two_stages(self.H)

    def _rows(self, keep: Tensor | slice) -> PreparedProgram:
        return self if self.H.ndim == 2 else PreparedProgram(self.H[keep], self.lower, self.upper)

    @torch.no_grad()
    def _in_chunks(self, f: Tensor, start: Tensor | None, tolerance: float) -> Tensor:
        """The minimisers (B,N), float64, as many at once as stay in a cache."""
        count, size = f.shape
        solution = torch.empty_like(f)
        numbers = _CHUNK_NUMBERS.get(f.device.type, _CHUNK_NUMBERS["other"])
        most = max(_LEAST_FRAMES, numbers // (2 * size)) if self.H.ndim == 2 else max(1, numbers // size**2)
        chunk = max(1, -(-count // max(1, -(-count // most))))  # all of about one size: a short one costs as many calls
        chunk += -chunk % 16  # products are quicker where each row of a variable begins on a cache line
        for first in range(0, count, chunk):
            rows = slice(first, first + chunk)
            part = self._rows(rows)
            problem = BoxProblem.of(part.H, f[rows], self.lower, self.upper)
            check_slope(problem)
            factors = self._factors if self.H.ndim == 2 else None
            x = solve_batch(problem, factors, None if start is None else start[rows], tolerance)
            check_bounded(problem, x)
            solution[rows] = x
        return solution
