"""Box-constrained quadratic programs prepared once for many calls, and the choice of their solver."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import TypeAlias

import daqp
import numpy as np
import torch
from torch import Tensor

from torchface.optim.batched_program import solve_alike, solve_batch
from torchface.optim.box_checks import check_bounded, check_finite, check_slope, checked_bounds, checked_hessian
from torchface.optim.box_problem import BoxProblem, metric
from torchface.optim.operator_splitting import SplittingFactors, prepare_two_stages

Array: TypeAlias = "np.ndarray"

# What DAQP takes for no bound, and squared slopes beyond which its objective would overflow.
_NO_BOUND, _STEEPEST = 1e30, 1e30
# How far a variable may leave its bounds, in the scale in which the diagonal of H is one.
_PRIMAL_TOLERANCE = 1e-9
_ROUNDING = 1e-12
_NONE = np.zeros(0, np.int64)


class OneByOne:
    r"""Problems of one H, factored once, or of an H each, one at a time by DAQP, a compiled dual active set.

    Each starts from the active set of the one before, the first of several from none, so that the same call gives the
    same bits.

    Args:
        H: (N,N) or (B,N,N), symmetric, positive semidefinite, float64, on the processor.
        lower, upper: (N,), float64, infinite where there is no bound.

    Source: Arnström, Bemporad and Axehill 2022, A dual active-set solver for embedded quadratic programming.
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


# Measured on 16 to 600 variables: DAQP is the faster one for up to so many problems of one H, each of which takes it a
# time that grows as variables cubed and a constant; with an H each for so many, and for up to so many variables in what
# is left of more.
_FEW, _CONSTANT, _FEW_OWN, _FEW_VARIABLES = 230**3, 40**3, 24, 80
# Numbers in one chunk of problems with an H each, twice those of one H, but so many frames at least: more take a fifth
# longer where other work fills the third-level cache; an accelerator wants more. Problems taken as alike are so many
# times as many.
_CHUNK_NUMBERS, _LEAST_FRAMES = {"cpu": 2**17, "other": 2**23}, 256
_ALIKE_SHARE = 8


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
            exact, guess = f.detach().double(), None if start is None else start.detach().double()
            x = self._in_chunks(exact, guess, tolerance) if self.H.ndim == 2 else self._alike(exact, guess, tolerance)
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
        return _FEW / (size**3 + _CONSTANT) if self.H.ndim == 2 else _FEW_OWN

    @cached_property
    def _one_by_one(self) -> OneByOne:
        return OneByOne(self.H, self.lower, self.upper)

    @cached_property
    def _factors(self) -> SplittingFactors:
        return prepare_two_stages(self.H)

    def _rows(self, keep: Tensor | slice) -> PreparedProgram:
        return self if self.H.ndim == 2 else PreparedProgram(self.H[keep], self.lower, self.upper)

    @torch.no_grad()
    def _alike(self, f: Tensor, start: Tensor | None, tolerance: float) -> Tensor:
        """The minimisers (B,N), float64, of problems with an H each, first taken as much alike."""
        found, solved = torch.empty_like(f), torch.empty(len(f), dtype=torch.bool, device=f.device)
        for rows, problem in self._chunks(f, _ALIKE_SHARE):
            found[rows], solved[rows] = solve_alike(problem, None if start is None else start[rows], tolerance)
            check_bounded(problem.rows(solved[rows]), found[rows][solved[rows]])
        rest = (~solved).nonzero()[:, 0]
        if len(rest):
            part, slopes, by_daqp = self._rows(rest), f[rest], self._few >= 0
            found[rest] = (
                part._solve_few(slopes.numpy(), tolerance) if by_daqp else part._in_chunks(slopes, None, tolerance)
            )
        return found

    @torch.no_grad()
    def _in_chunks(self, f: Tensor, start: Tensor | None, tolerance: float) -> Tensor:
        """The minimisers (B,N), float64, as many at once as stay in a cache."""
        solution = torch.empty_like(f)
        factors = self._factors if self.H.ndim == 2 else None
        for rows, problem in self._chunks(f, 1):
            x = solve_batch(problem, factors, None if start is None else start[rows], tolerance)
            check_bounded(problem, x)
            solution[rows] = x
        return solution

    def _chunks(self, f: Tensor, share: int) -> Iterator[tuple[slice, BoxProblem]]:
        count, size = f.shape
        numbers = share * _CHUNK_NUMBERS.get(f.device.type, _CHUNK_NUMBERS["other"])
        most = max(_LEAST_FRAMES, numbers // (2 * size)) if self.H.ndim == 2 else max(1, numbers // size**2)
        chunk = max(1, -(-count // max(1, -(-count // most))))  # all of about one size: a short one costs as many calls
        chunk += -chunk % 16  # products are quicker where each row of a variable begins on a cache line
        for first in range(0, count, chunk):
            rows = slice(first, first + chunk)
            problem = BoxProblem.of(self._rows(rows).H, f[rows], self.lower, self.upper)
            check_slope(problem)
            yield rows, problem
