"""Box-constrained quadratic programs in batches: the solver behind every blendshape solve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from torchface.errors import ShapeError, TraceError, ValueRangeError
from torchface.number_checks import checked_number
from torchface.optim.active_set import projected_newton
from torchface.optim.box_problem import BoxProblem, check_box, metric
from torchface.optim.compiled_program import CompiledProgram, compiled_solver_installed
from torchface.optim.data_dependent import data_dependent
from torchface.optim.implicit import BoxSolution
from torchface.optim.operator_splitting import (
    SplittingFactors,
    extrapolated_splitting,
    prepare_splitting,
    splitting_steps,
    start_splitting,
    suited_rho,
)
from torchface.optim.prepared_tensors import Prepared
from torchface.optim.primal_dual_active_set import primal_dual_active_set
from torchface.optim.single_program import SingleProgram

# Cycles of splitting before the active set is tried, times the root of N; then steps of splitting and Newton steps for
# what it does not settle, an H that is singular or close to it: splitting brings such problems near enough for Newton
# steps to end them, and the last ones make sure.
_FIRST_CYCLES = 0.235
# Few variables and a coarse tolerance: so many steps of splitting alone end nearly always, sooner than a factorisation.
_COARSE_ROUNDS = ((None, 48), (None, 32), (None, 32))
_COARSE, _FEW_VARIABLES = 1e-7, 64
_SETTLING_ROUNDS = 4
_LATER_ROUNDS = ((4, 100), (4, 200), (4, 400), (4, 400))
_CAREFUL_ROUNDS = ((8, 400), (8, 800), (8, 1600), (100, 0))
# So many problems are solved one by one.
_FEW = 8
# The residual is relative to x and so falls where x runs away. It has, where x is this many times farther than each
# variable alone would go, or where the residual itself is still this share of that way.
_RUN_AWAY, _STILL_MOVING = 1e9, 1e-2
# A tolerance above it calls nearly every start a solution.
_COARSEST = 0.5
# Bounds within it end any run before the residual, relative to x, can call it solved.
_NEAR_BOUND = 1e3
# Splitting runs in float32, whose numbers end at 3e38.
_STEEPEST = 1e30
_TOLERANCE = {torch.float32: 3e-6, torch.float64: 1e-11}
# Numbers in one chunk of frames: three buffers of it stay in a CPU's second-level cache; an accelerator wants more.
_CHUNK_NUMBERS = {"cpu": 2**17, "other": 2**23}


def box_qp(
    H: Tensor,
    f: Tensor,
    lower: float | Tensor = 0.0,
    upper: float | Tensor = 1.0,
    start: Tensor | None = None,
    tolerance: float | None = None,
) -> Tensor:
    r"""The minimisers of quadratic functions over a box.

    .. math:: x = \arg\min_{l \le x \le u} \tfrac12 x^\top H x + f^\top x

    Solved by splitting (one factorisation, then products and clamps), then by projected Newton steps where digits are
    missing, all in float64 inside. Differentiable once in H and f, by implicit differentiation at the solution.

    Args:
        H: symmetric and positive semidefinite, (N,N) or (B,N,N), float32 or float64; only its symmetric part counts.
        f: (B,N), of the same dtype and device.
        lower: a number or (N,); ``-inf`` for none. Bounds are constants: no gradient flows to them.
        upper: a number or (N,); ``inf`` for none.
        start: a guess, (B,N), such as the frame before; the answer does not depend on it where it is unique.
        tolerance: on the residual :math:`\max |x - clip(x - (Hx+f)/\mathrm{diag} H)|`, relative to :math:`1 + |x|`;
            3e-6 for float32 and 1e-11 for float64 if absent; at most 0.5, and 0 for as near as rounding lets it.

    Returns:
        x, (B,N), within the bounds exactly. Where H is singular and the minimiser not unique, one of them.

    Raises:
        ShapeError: the shapes do not fit each other.
        ValueRangeError: H or f is not finite, H is not symmetric or has a negative eigenvalue, ``lower`` exceeds
            ``upper``, f is more than 1e30 times H's diagonal, ``tolerance`` is not in [0,0.5], or the objective falls
            without end because bounds are infinite or, where H is singular, so wide that no solution comes near them.

    Source: thesis 4.1.4 and appendix, equations 67 and 68.

    Example:
        >>> H = torch.tensor([[2.0, 0.0], [0.0, 4.0]])
        >>> box_qp(H, torch.tensor([[-1.0, -8.0], [2.0, -2.0]])).round(decimals=4).tolist()
        [[0.5, 1.0], [0.0, 0.5]]
    """
    with torch.no_grad():
        prepared = _PreparedHessian.of(H)
        bounds = _checked_bounds(lower, upper, prepared.exact)
        tolerance = _checked_tolerance(tolerance, H.dtype)
    return _minimiser(H, prepared, f, *bounds, start, tolerance)


class BoxQP(nn.Module):
    """``box_qp`` as a module that checks and factors H once for many calls.

    Calls of up to eight problems that ask for no gradients are made for live solving: on the processor they go to DAQP
    where it is installed (the extra ``live``; each from the active set of the call before), else to NumPy and LAPACK.

    H is a buffer, or a parameter where an ``nn.Parameter`` is given. What is prepared from it follows it: an
    optimiser's step, ``load_state_dict``, ``.to()`` and ``.double()`` take effect at the next call.

    Args:
        H: (N,N), or (B,N,N) for exactly B problems a call.
        lower, upper, tolerance: as in ``box_qp``.

    Raises:
        ShapeError, ValueRangeError: as in ``box_qp``; also at a call, where H has become unfit since.

    Example:
        >>> qp = BoxQP(torch.eye(2), lower=0.0, upper=float("inf"))
        >>> qp(torch.tensor([[-3.0, 1.0]])).round(decimals=4).tolist()
        [[3.0, 0.0]]
    """

    H: Tensor
    lower: Tensor
    upper: Tensor

    def __init__(
        self,
        H: Tensor,
        lower: float | Tensor = 0.0,
        upper: float | Tensor = 1.0,
        tolerance: float | None = None,
    ) -> None:
        super().__init__()
        self.tolerance = tolerance if tolerance is None else _checked_tolerance(tolerance, H.dtype)
        if isinstance(H, nn.Parameter):
            self.H = H
        else:
            self.register_buffer("H", H)
        self._prepared: Prepared[_PreparedHessian] = Prepared()
        exact = self._prepare().exact
        for name, bound in zip(("lower", "upper"), _checked_bounds(lower, upper, exact), strict=True):
            self.register_buffer(name, bound)

    @data_dependent("torchface.onnx.SolverGraph, or steps of torchface.optim.exported_operators, which are fixed")
    def forward(self, f: Tensor, start: Tensor | None = None) -> Tensor:
        """The minimisers (B,N) for f (B,N), of H's dtype; ``start`` is an initial guess (B,N)."""
        tolerance = _TOLERANCE[self.H.dtype] if self.tolerance is None else self.tolerance
        return _minimiser(self.H, self._prepare(), f, self.lower, self.upper, start, tolerance)

    def _prepare(self) -> _PreparedHessian:
        return self._prepared.get((self.H,), lambda: _PreparedHessian.of(self.H))

    def extra_repr(self) -> str:
        return f"{self.H.shape[-1]} variables"


@dataclass(frozen=True, eq=False)
class _PreparedHessian:
    """The symmetric part of H in float64, and the factors of one H for all problems."""

    exact: Tensor
    factors: SplittingFactors | None

    @cached_property
    def compiled(self) -> CompiledProgram | None:
        """The same where DAQP is installed."""
        single = self.single
        if single is None or not compiled_solver_installed():
            return None
        return CompiledProgram(single.H, single.diagonal)

    @cached_property
    def single(self) -> SingleProgram | None:
        """For calls of few problems; on an accelerator, or with an H for each problem, there is none."""
        if self.factors is None or self.exact.device.type != "cpu":
            return None
        return SingleProgram.of(self.exact, self.factors)

    @classmethod
    def of(cls, H: Tensor) -> _PreparedHessian:
        exact = _checked_hessian(H)
        return cls(exact, prepare_splitting(exact, suited_rho(exact)) if H.ndim == 2 else None)


def _minimiser(
    H: Tensor,
    prepared: _PreparedHessian,
    f: Tensor,
    lower: Tensor,
    upper: Tensor,
    start: Tensor | None,
    tolerance: float,
) -> Tensor:
    """The minimisers (B,N), differentiable in H and f where these ask for it."""
    quick = _solved_singly(H, prepared, f, lower, upper, start, tolerance)
    if quick is not None:
        return quick
    if torch.jit.is_tracing():
        raise TraceError(
            "box_qp: iterates until every problem is solved, and a trace would repeat one frame's path for all; "
            "expected an ONNX graph made by `torchface export solver` (or torchface.onnx), which fixes the iterations"
        )
    _check_vectors(H, f, start)
    lower, upper = lower.double(), upper.double()
    if torch.is_grad_enabled() and (H.requires_grad or f.requires_grad):
        solution: Tensor = BoxSolution.apply(
            H, f, lower, upper, lambda: _solve_in_chunks(prepared, f, lower, upper, start, tolerance)
        )
        return solution
    return _solve_in_chunks(prepared, f, lower, upper, start, tolerance)


@torch.no_grad()
def _solve_in_chunks(
    prepared: _PreparedHessian, f: Tensor, lower: Tensor, upper: Tensor, start: Tensor | None, tolerance: float
) -> Tensor:
    count, variables = f.shape
    shared = prepared.exact.ndim == 2
    solution = torch.empty_like(f)
    numbers = _CHUNK_NUMBERS.get(f.device.type, _CHUNK_NUMBERS["other"])
    chunk = max(1, numbers // max(variables if shared else variables**2, 1))
    for first in range(0, count, chunk):
        rows = slice(first, first + chunk)
        H = prepared.exact if shared else prepared.exact[rows]
        problem = BoxProblem.of(H, f[rows].double(), lower, upper)
        _check_slope(problem)
        factors = prepare_splitting(H, suited_rho(H)) if prepared.factors is None else prepared.factors
        x = _solve(problem, factors, None if start is None else start[rows].double(), tolerance)
        # Rounding to float32 must not step over a bound.
        solution[rows] = torch.minimum(torch.maximum(x.to(f.dtype), lower.to(f)), upper.to(f))
    return solution


def _solved_singly(
    H: Tensor,
    prepared: _PreparedHessian,
    f: Tensor,
    lower: Tensor,
    upper: Tensor,
    start: Tensor | None,
    tolerance: float,
) -> Tensor | None:
    """The minimisers (B,N) of few problems that ask for no gradients, one by one, where each is found.

    What is not as it should be is left to the checks of a batch.
    """
    if f.ndim != 2 or not 0 < len(f) <= _FEW or f.shape[1] != H.shape[-1] or f.dtype != H.dtype or not f.is_cpu:
        return None
    if start is not None and (start.shape != f.shape or not start.is_cpu):
        return None
    program, compiled = prepared.single, prepared.compiled
    if program is None or torch.jit.is_tracing() or (torch.is_grad_enabled() and (H.requires_grad or f.requires_grad)):
        return None
    low, high, slopes = lower.double().numpy(), upper.double().numpy(), f.detach().double().numpy()
    found = np.empty(f.shape)
    for row, slope in enumerate(slopes):  # a batch of few takes as long as a dozen of these
        x = None if compiled is None else compiled.solve(slope, low, high, tolerance)
        if x is None:
            x = program.solve(
                slope, low, high, None if start is None else start[row].detach().double().numpy(), tolerance
            )
        if x is None:
            return None
        found[row] = x
    if f.dtype == torch.float32:
        # Rounding must not step over a bound.
        found = np.minimum(np.maximum(found.astype(np.float32), low), high).astype(np.float32)
    return torch.from_numpy(found)


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
        if newton_steps:
            found, gradient = projected_newton(part, state.z, tolerance, newton_steps, number >= quick), None
        elif newton_steps is not None and (number or start is not None):
            found, gradient = primal_dual_active_set(part, state.z)
        else:
            found, gradient = state.z, None
        x[rows] = found
        keep = part.unsolved(found, tolerance, gradient).nonzero()[:, 0]
        if not len(keep):
            break
        if len(keep) < len(rows):
            rows, part, state, factors = rows[keep], part.rows(keep), state.rows(keep), factors.rows(keep)
        if newton_steps or newton_steps is None:
            dtype = torch.float32 if number < quick else torch.float64
            state = splitting_steps(part, factors, state, steps, dtype=dtype)
        else:
            state = extrapolated_splitting(part, factors, state, steps)
    _check_bounded(problem, x)
    return x


def _checked_hessian(H: Tensor) -> Tensor:
    """The symmetric part of H in float64, after every check that needs no f."""
    if H.ndim not in (2, 3) or H.shape[-1] != H.shape[-2] or H.shape[-1] == 0:
        raise ShapeError(f"box_qp: found H {tuple(H.shape)}, expected (N,N) or (B,N,N)")
    if H.dtype not in _TOLERANCE:
        raise ValueRangeError(f"box_qp: found H of {H.dtype}, expected float32 or float64")
    exact = H.detach().double()
    if not torch.isfinite(exact).all():
        raise ValueRangeError("box_qp: H holds NaN or infinite entries, expected finite ones")
    precision = torch.finfo(H.dtype).eps * H.shape[-1]
    largest = exact.abs().amax((-1, -2)) if exact.numel() else exact.new_zeros(len(exact))
    skew = (exact - exact.transpose(-1, -2)).abs().amax((-1, -2)) if exact.numel() else largest
    if (skew > 100 * precision * largest).any():
        raise ValueRangeError(
            f"box_qp: H is not symmetric: entries differ from their mirror images by up to {float(skew.max()):.3g}"
        )
    exact = 0.5 * (exact + exact.transpose(-1, -2))
    scale = metric(exact).rsqrt()
    lifted = exact * scale[..., :, None] * scale[..., None, :]
    lifted.diagonal(dim1=-2, dim2=-1).add_(100 * precision)
    if (torch.linalg.cholesky_ex(lifted)[1] > 0).any():
        least = float(torch.linalg.eigvalsh(exact).min())
        raise ValueRangeError(
            f"box_qp: H is not positive semidefinite: found the eigenvalue {least:.3g}, expected none below 0"
        )
    return exact


def _checked_bounds(lower: float | Tensor, upper: float | Tensor, H: Tensor) -> tuple[Tensor, Tensor]:
    variables = H.shape[-1]
    bounds = []
    for name, bound in (("lower", lower), ("upper", upper)):
        bound = torch.as_tensor(bound, dtype=torch.float64, device=H.device).detach()
        if bound.ndim and bound.shape != (variables,):
            raise ShapeError(f"box_qp: found {name} {tuple(bound.shape)}, expected a number or ({variables},)")
        bounds.append(bound.expand(variables).contiguous())
    low, high = bounds
    check_box("box_qp", low, high)
    return low, high


def _checked_tolerance(tolerance: float | None, dtype: torch.dtype) -> float:
    return _TOLERANCE[dtype] if tolerance is None else checked_number("box_qp: tolerance", tolerance, 0.0, _COARSEST)


def _check_vectors(H: Tensor, f: Tensor, start: Tensor | None) -> None:
    if f.ndim != 2 or f.shape[1] != H.shape[-1] or (H.ndim == 3 and len(H) != len(f)):
        wanted = f"({len(H)},{H.shape[-1]})" if H.ndim == 3 else f"(B,{H.shape[-1]})"
        raise ShapeError(f"box_qp: found f {tuple(f.shape)}, expected {wanted} for H {tuple(H.shape)}")
    if f.dtype != H.dtype:
        raise ValueRangeError(f"box_qp: found f of {f.dtype} and H of {H.dtype}, expected the same")
    if start is not None and start.shape != f.shape:
        raise ShapeError(f"box_qp: found start {tuple(start.shape)}, expected {tuple(f.shape)}")
    for name, vectors in (("f", f), ("start", start)):
        if vectors is not None and not torch.isfinite(vectors).all():
            bad = (~torch.isfinite(vectors)).any(1).nonzero()[:, 0].tolist()
            raise ValueRangeError(f"box_qp: {name} holds NaN or infinite entries in rows {bad[:5]}")


def _check_slope(problem: BoxProblem) -> None:
    steep = problem.f.abs() > _STEEPEST * problem.diagonal
    if bool(steep.any()):
        found = float((problem.f.abs() / problem.diagonal).amax())
        raise ValueRangeError(
            f"box_qp: found f {found:.2g} times the diagonal of H, expected at most {_STEEPEST:.0e} times: beyond it "
            "numbers overflow; is a weight of a term far too large or too small?"
        )


def _check_bounded(problem: BoxProblem, x: Tensor) -> None:
    wide = torch.maximum(problem.lower.abs(), problem.upper.abs()).amax()
    if wide <= _NEAR_BOUND:
        return
    scale = 1 + (problem.f / problem.diagonal).abs().amax(-1)
    step = x - problem.clip(x - problem.gradient(x) / problem.diagonal)
    far = torch.where((x > problem.lower) & (x < problem.upper), x.abs(), 0.0).amax(-1)
    lost = (far > _RUN_AWAY * scale) | (step.abs().amax(-1) > _STILL_MOVING * scale)
    if lost.any():
        raise ValueRangeError(
            f"box_qp: the objective of {int(lost.sum())} problems has no minimum: H is singular, bounds infinite"
            if torch.isinf(wide)
            else f"box_qp: the objective of {int(lost.sum())} problems falls farther than numbers carry: H is "
            f"singular, bounds reach {float(wide):g}; expected bounds near the solutions, or a ridge on H"
        )
