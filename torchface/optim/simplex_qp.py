"""Quadratic programs on the simplex in batches: convex combinations of many, of which few take part."""

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import as_tensor, checked_number
from torchface.optim.box_checks import as_vectors, check_finite
from torchface.optim.implicit import SimplexSolution
from torchface.optim.simplex_active_set import Mixture, SimplexProblems, solve_simplex

_TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-10}


def simplex_qp(H: Tensor, f: Tensor, start: Tensor | None = None, tolerance: float | None = None) -> Tensor:
    r"""The minimisers of quadratic functions over the simplex.

    .. math:: x = \arg\min_{x \ge 0,\; \mathbf 1^\top x = 1} \tfrac12 x^\top H x + f^\top x

    Of many variables few take part: those whose gradients lie furthest below the others' join them, the small problem
    among these alone is solved exactly, and so on until none lies below. Float64 inside, all problems at once.
    Differentiable once in H and f, by implicit differentiation at the solution.

    Args:
        H: symmetric and positive semidefinite, (N,N) or (B,N,N), float32 or float64; only its symmetric part counts.
            Or (G,N,N) for f of three dimensions.
        f: (B,N), of the same dtype and device; or (G,B,N), B problems of each of G matrices.
        start: a guess on the simplex, as f, such as the frame before: its positive variables take part first. The
            answer does not depend on it where it is unique.
        tolerance: on the residual :math:`\max_i (\mu - g_i)`, with g the gradient and :math:`\mu = x^\top g` the
            multiplier of the sum, relative to the range of :math:`\operatorname{diag} H` and f; 1e-6 for float32 and
            1e-10 for float64 if absent.

    Returns:
        x, as f, non-negative, of sum 1. Where the minimiser is not unique, one of them.

    Raises:
        ShapeError: the shapes do not fit each other.
        ValueRangeError: an entry is not finite, H is not symmetric or has a negative diagonal, or ``start`` is negative
            or of sum 0.

    Source: Wolfe 1976, Finding the nearest point in a polytope; Facial Performance Enhancement Using Dynamic Shape
    Space Analysis, section 5.3.

    Example:
        >>> H = torch.tensor([[2.0, 0.0], [0.0, 2.0]])
        >>> simplex_qp(H, torch.tensor([[0.0, 0.0], [0.0, -1.0], [5.0, 0.0]])).round(decimals=4).tolist()
        [[0.5, 0.5], [0.25, 0.75], [0.0, 1.0]]
    """
    return SimplexQP(H)(f, start, tolerance)


class SimplexQP:
    """``simplex_qp`` that checks H once for many calls.

    Args:
        H: (N,N), (B,N,N) or (G,N,N), as in ``simplex_qp``; not to be changed afterwards.

    Raises:
        ShapeError, ValueRangeError: as in ``simplex_qp``.

    Example:
        >>> qp = SimplexQP(torch.eye(2))
        >>> qp(torch.tensor([[0.0, -1.0]])).tolist()
        [[0.0, 1.0]]
    """

    def __init__(self, H: Tensor) -> None:
        H = as_tensor("H", H, "(N,N) or (B,N,N)")
        _check_matrices(H)
        self._H = H
        exact = H.detach().double()
        self._exact = 0.5 * (exact + exact.transpose(-1, -2))

    def __call__(self, f: Tensor, start: Tensor | None = None, tolerance: float | None = None) -> Tensor:
        """The minimisers for f; arguments and errors are those of ``simplex_qp``."""
        H = self._H
        f = as_vectors("f", f, H)
        _check_vectors(H, f, start)
        if not f.numel():
            return f.clone()
        limit = _TOLERANCE[H.dtype]
        if tolerance is not None:
            limit = checked_number("simplex_qp: tolerance", tolerance, 0.0, 0.5)
        with torch.no_grad():
            begin = None if start is None else start.detach().double()
            found = self._solved(f.detach().double(), begin, limit).to(f.dtype)
        if not (torch.is_grad_enabled() and (H.requires_grad or f.requires_grad)):
            return found
        if f.ndim == 2:
            return _differentiable(H, f, found)
        return torch.stack([_differentiable(*group) for group in zip(H, f, found, strict=True)])

    def _solved(self, f: Tensor, start: Tensor | None, tolerance: float) -> Tensor:
        variables = f.shape[-1]
        matrices = self._exact.view(-1, variables, variables)
        flat = f.reshape(-1, variables)
        matrix = torch.arange(len(flat), device=f.device) // (len(flat) // len(matrices))
        diagonal = matrices.diagonal(dim1=1, dim2=2)[matrix]
        scale = diagonal.amax(1) + flat.amax(1) - flat.amin(1)
        scale = torch.where(scale > 0, scale, torch.ones_like(scale))
        problems = SimplexProblems(matrices.flatten(0, 1), matrix * variables, flat, tolerance * scale)
        if start is None:
            best = (0.5 * diagonal + flat).argmin(1, keepdim=True)
            begin = Mixture(best, torch.ones_like(best, dtype=flat.dtype))
        else:
            begin = Mixture.of(start.reshape(flat.shape))
        return solve_simplex(problems, begin).view(f.shape)


def _differentiable(H: Tensor, f: Tensor, solution: Tensor) -> Tensor:
    found: Tensor = SimplexSolution.apply(H, f, lambda: solution)
    return found


def _check_matrices(H: Tensor) -> None:
    if H.ndim not in (2, 3) or H.shape[-1] != H.shape[-2] or H.shape[-1] == 0:
        raise ShapeError(f"simplex_qp: found H {tuple(H.shape)}, expected (N,N), (B,N,N) or (G,N,N)")
    if H.dtype not in _TOLERANCE:
        raise ValueRangeError(f"simplex_qp: found H of {H.dtype}, expected float32 or float64")
    known = H.detach()
    if not len(known):
        return
    if not bool(torch.isfinite(known).all()):
        raise ValueRangeError("simplex_qp: H holds NaN or infinite entries, expected finite ones")
    largest = float(known.abs().max())
    if float((known - known.transpose(-1, -2)).abs().max()) > 1e2 * torch.finfo(H.dtype).eps * H.shape[-1] * largest:
        raise ValueRangeError("simplex_qp: H is not symmetric")
    if float(known.diagonal(dim1=-2, dim2=-1).amin()) < 0:
        raise ValueRangeError("simplex_qp: H has a negative diagonal, expected a positive semidefinite one")


def _check_vectors(H: Tensor, f: Tensor, start: Tensor | None) -> None:
    fits = f.ndim == 2 or (f.ndim == 3 and H.ndim == 3)
    if not fits or f.shape[-1] != H.shape[-1] or (H.ndim == 3 and len(H) != len(f)):
        expected = f"(B,{H.shape[-1]})" + (f" or ({len(H)},B,{H.shape[-1]})" if H.ndim == 3 else "")
        raise ShapeError(f"simplex_qp: found f {tuple(f.shape)} for H {tuple(H.shape)}, expected {expected}")
    if f.dtype != H.dtype:
        raise ValueRangeError(f"simplex_qp: found {H.dtype} and {f.dtype}, expected the same of both")
    if start is not None and start.shape != f.shape:
        raise ShapeError(f"simplex_qp: found start {tuple(start.shape)}, expected {tuple(f.shape)}")
    check_finite(f, start, "simplex_qp")
    if start is not None and start.numel() and not (float(start.amin()) >= 0 and float(start.sum(-1).amin()) > 0):
        raise ValueRangeError("simplex_qp: found a negative start or one of sum 0, expected points of the simplex")
