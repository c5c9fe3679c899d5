"""Checks of box-constrained quadratic programs: what does not fit, is not finite, or has no minimum."""

from numbers import Real

import torch
from scipy.linalg.lapack import dpotrf
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import as_tensor, checked_number
from torchface.optim.blas_threads import one_blas_thread
from torchface.optim.box_problem import BoxProblem, check_box, metric
from torchface.optim.data_dependent import is_recorded, is_transformed

_TOLERANCE = {torch.float32: 3e-6, torch.float64: 1e-11}
# A tolerance above it calls nearly every start a solution.
_COARSEST = 0.5
# The residual is relative to x and so falls where x runs away. It has, where x is this many times farther than each
# variable alone would go, or where the residual itself is still this share of that way.
_RUN_AWAY, _STILL_MOVING = 1e9, 1e-2
# Bounds within it end any run before the residual, relative to x, can call it solved.
_NEAR_BOUND = 1e3
# Splitting runs in float32, whose numbers end at 3e38.
_STEEPEST = 1e30
# Matrices that are factored in memory which stays in a cache.
_CHUNK = 64


def checked_hessian(H: Tensor, name: str = "box_qp") -> Tensor:
    """The symmetric part of H in float64, after every check that needs no f."""
    if H.ndim not in (2, 3) or H.shape[-1] != H.shape[-2] or H.shape[-1] == 0:
        raise ShapeError(f"{name}: found H {tuple(H.shape)}, expected (N,N) or (B,N,N)")
    if H.dtype not in _TOLERANCE:
        raise ValueRangeError(f"{name}: found H of {H.dtype}, expected float32 or float64")
    exact = H.detach().double().contiguous()
    if not _finite(exact):
        raise ValueRangeError(f"{name}: H holds NaN or infinite entries, expected finite ones")
    if not torch.equal(exact, exact.mT):
        largest, skew = exact.abs().amax((-1, -2)), (exact - exact.mT).abs().amax((-1, -2))
        # Only the symmetric part counts, and an H of float32 that went to double precision keeps its rounding.
        if (skew > 100 * torch.finfo(torch.float32).eps * H.shape[-1] * largest).any():
            raise ValueRangeError(
                f"{name}: H is not symmetric: entries differ from their mirror images by up to {float(skew.max()):.3g}"
            )
        exact = 0.5 * (exact + exact.mT)
    lift = 100 * torch.finfo(H.dtype).eps * H.shape[-1] * metric(exact)
    if not all(map(_all_factor, exact.view(-1, *H.shape[-2:]).split(_CHUNK), lift.view(-1, H.shape[-1]).split(_CHUNK))):
        least = float(torch.linalg.eigvalsh(exact).min())
        raise ValueRangeError(
            f"{name}: H is not positive semidefinite: found the eigenvalue {least:.3g}, expected none below 0"
        )
    return exact


def _all_factor(H: Tensor, lift: Tensor) -> bool:
    """Whether Cholesky's factorisation of each H (B,N,N) succeeds, its diagonal raised by (B,N)."""
    lifted = H.clone()
    lifted.diagonal(dim1=-2, dim2=-1).add_(lift)
    if H.device.type != "cpu":
        return not bool((torch.linalg.cholesky_ex(lifted)[1] > 0).any())
    # One by one by LAPACK takes half of torch's time.
    with one_blas_thread(H.shape[-1]):
        return not any(dpotrf(one.T, lower=1, clean=0, overwrite_a=1)[1] for one in lifted.numpy())


def checked_bounds(
    lower: float | Tensor, upper: float | Tensor, H: Tensor | None, name: str = "box_qp"
) -> tuple[Tensor, Tensor]:
    """Bounds in float64, (N,); numbers alone stay numbers where there is no H yet."""
    bounds = []
    for which, bound in (("lower", lower), ("upper", upper)):
        if not isinstance(bound, Real):
            bound = as_tensor(which, bound, "(N,), or a number")
        bounds.append(torch.as_tensor(bound, dtype=torch.float64, device=None if H is None else H.device).detach())
    size = max((bound.shape[:1] for bound in bounds), key=len) if H is None else H.shape[-1:]
    for which, bound in zip(("lower", "upper"), bounds, strict=True):
        if bound.ndim and bound.shape != size:
            raise ShapeError(f"{name}: found {which} {tuple(bound.shape)}, expected a number or ({size[0]},)")
    low, high = (bound.expand(size).contiguous() for bound in bounds)
    check_box(name, low, high)
    return low, high


def default_tolerance(dtype: torch.dtype) -> float:
    """What is asked of a solution in this dtype; of a single one where it is neither."""
    return _TOLERANCE.get(dtype, _TOLERANCE[torch.float32])


def checked_tolerance(tolerance: float | None, dtype: torch.dtype) -> float:
    if tolerance is None:
        return default_tolerance(dtype)
    return checked_number("box_qp: tolerance", tolerance, 0.0, _COARSEST)


def check_vectors(H: Tensor, f: Tensor, start: Tensor | None, name: str = "box_qp") -> None:
    if f.ndim != 2 or f.shape[1] != H.shape[-1] or (H.ndim == 3 and len(H) != len(f)):
        wanted = f"({len(H)},{H.shape[-1]})" if H.ndim == 3 else f"(B,{H.shape[-1]})"
        raise ShapeError(f"{name}: found f {tuple(f.shape)}, expected {wanted} for H {tuple(H.shape)}")
    if f.dtype != H.dtype:
        raise ValueRangeError(f"{name}: found f of {f.dtype} and H of {H.dtype}, expected the same")
    if start is not None and start.shape != f.shape:
        raise ShapeError(f"{name}: found start {tuple(start.shape)}, expected {tuple(f.shape)}")


def as_vectors(which: str, values: Tensor, H: Tensor) -> Tensor:
    """Vectors (B,N) as a tensor; whole numbers and what is none in the dtype of H."""
    values = as_tensor(which, values, "(B,N)", H.dtype)
    return values if values.is_floating_point() else values.to(H.dtype)


def check_call(H: Tensor, f: Tensor, start: Tensor | None, name: str, lower: float | Tensor) -> None:
    """Checks what a layer is called with; a graph and the transforms of ``torch.func`` cannot ask for numbers."""
    if is_recorded() or is_transformed():
        return
    check_vectors(H, f, start, name)
    check_finite(f, start, name)
    if isinstance(lower, Tensor) and lower.ndim and len(lower) != f.shape[1]:
        raise ShapeError(f"{name}: found f {tuple(f.shape)}, expected {len(lower)} columns, as of bounds")
    if not _finite(H):
        raise ValueRangeError(f"{name}: H holds NaN or infinite entries, expected finite ones")


def check_finite(f: Tensor, start: Tensor | None, name: str = "box_qp") -> None:
    for which, vectors in (("f", f), ("start", start)):
        if vectors is not None and not _finite(vectors):
            bad = (~torch.isfinite(vectors)).any(1).nonzero()[:, 0].tolist()
            raise ValueRangeError(f"{name}: {which} holds NaN or infinite entries in rows {bad[:5]}")


def _finite(values: Tensor) -> bool:
    """A sum shows NaN and infinity sooner than a look at each; where it overflows each is looked at."""
    return bool(torch.isfinite(values.sum())) or bool(torch.isfinite(values).all())


def check_slope(problem: BoxProblem) -> None:
    steep = problem.f.abs() > _STEEPEST * problem.diagonal
    if bool(steep.any()):
        found = float((problem.f.abs() / problem.diagonal).amax())
        raise ValueRangeError(
            f"box_qp: found f {found:.2g} times the diagonal of H, expected at most {_STEEPEST:.0e} times: beyond it "
            "numbers overflow; is a weight of a term far too large or too small?"
        )


def check_bounded(problem: BoxProblem, x: Tensor) -> None:
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
