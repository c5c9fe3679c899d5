"""Box-constrained quadratic programs by a fixed number of splitting's steps: one module for PyTorch and for ONNX."""

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from numbers import Real
from typing import Any

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError
from torchface.number_checks import as_tensor, checked_count, checked_number
from torchface.optim.box_checks import check_call, checked_bounds, checked_hessian
from torchface.optim.full_precision import full_precision
from torchface.optim.operator_splitting import RELAXATION, RHO, prepare_splitting

STEPS = 66
_NAME = "FixedSplitting"
_SMALLEST_DIAGONAL = 1e-6  # a share of the largest; smaller ones would overflow the scaling
# Shares of the steps after which the constant is formed again from the gradient: early, so that what the inverse's
# rounding left behind in slow modes is gone at the end.
_FORMED_AGAIN = (0.09, 0.27)
_START = 1.5  # of Newton's iteration, over a norm; below 2 it converges


class FixedSplitting(nn.Module):
    r"""Solves box QPs, not exactly, by matrix products and clamps alone.

    .. math:: \min \tfrac12 x^\top H x + f^\top x,\ l \le x \le u, \qquad
        v' = c - v\,G + z\,(2G + (2 - \alpha) I), \quad z' = \mathrm{clip}(v', l, u)

    A step is that of ``torchface.optim.operator_splitting``, with :math:`t = 2z - v` written out. One H is factored
    here. Problems with an H each take Newton's iteration for the inverse of :math:`A = H + \rho D` scaled to a unit
    diagonal, :math:`X' = X (2I - AX)`: A's condition is at most about :math:`N / \rho`, so a dozen products suffice.

    66 steps end where the objective is 1e-9 to 1e-4 of itself above the least, and weights are 1e-5 to 6e-2 off, most
    where H is flat.

    The constant c is formed in the precision of f, float64, in which a shape that moves markers by hundredths of a
    millimetre is not lost beside others that move them by centimetres; the steps run in that of the buffers, float32.

    Args:
        H: of all problems, (N,N), positive semidefinite; absent if each call brings one a problem.
        lower, upper: the box, numbers or (N,), infinite for none.
        steps: how many.
        rho: :math:`\rho`, of the metric.

    Raises:
        ShapeError, ValueRangeError: H or the bounds are unfit, as for ``box_qp``, less than one step, or a ``rho`` that
            is not positive.

    Source: Boyd et al. 2011, 3.4.3 and 5.2; Schulz 1933 for the inverse.

    Example:
        >>> H = torch.tensor([[2.0, 1.0], [1.0, 2.0]], dtype=torch.float64)
        >>> FixedSplitting(H)(torch.tensor([[-1.0, 4.0]], dtype=torch.float64)).round(decimals=5).tolist()
        [[0.5, 0.0]]
    """

    offset: Tensor
    minus_step: Tensor
    double_step: Tensor

    def __init__(
        self,
        H: Tensor | None = None,
        lower: float | Tensor = 0.0,
        upper: float | Tensor = 1.0,
        steps: int = STEPS,
        rho: float = RHO,
    ) -> None:
        super().__init__()
        checked_count("fixed splitting: steps", steps, 1)
        self.steps, self.rho = steps, rho
        checked_number("fixed splitting: rho", rho, above=True)
        # A whole number, as a compiled call takes it for a constant.
        self._doublings = math.ceil(math.log2(16 / (_START * rho)))
        offset = step = torch.zeros(0, 0, dtype=torch.float64)
        H = None if H is None else as_tensor("H", H, "(N,N)")
        if H is not None:
            if H.ndim != 2:
                raise ShapeError(f"{_NAME}: found H {tuple(H.shape)}, expected (N,N), or one of each problem at a call")
            factors = prepare_splitting(checked_hessian(H, _NAME), rho)
            offset, step = factors.offset, factors.step
        double_step = 2 * step
        double_step.diagonal().add_(2 - RELAXATION)
        low, high = checked_bounds(lower, upper, H, _NAME)
        numbers = isinstance(lower, Real) and isinstance(upper, Real)  # by which clamps are quicker
        self.box: Any = (float(lower), float(upper)) if numbers else (low, high)
        self.register_buffer("offset", offset)
        self.register_buffer("minus_step", -step.float())
        self.register_buffer("double_step", double_step.float())

    @full_precision
    def forward(self, f: Tensor, H: Tensor | None = None, start: Tensor | None = None) -> Tensor:
        """The solutions, (B,N), in the precision of the buffers.

        Args:
            f: (B,N), float64.
            H: of each problem, (B,N,N), or of all, (N,N), float64; the one given before if absent.
            start: (B,N); zero if absent.

        Raises:
            ShapeError, ValueRangeError: the inputs do not fit each other or are not finite. A compiled or exported
                call, and one under a transform, is not checked.
        """
        f = as_tensor("f", f, "(B,N)")
        f = f.to(torch.promote_types(f.dtype, self.minus_step.dtype))
        if H is None and not len(self.offset):
            raise ShapeError(f"{_NAME}: found no H, expected one here or where the module is made")
        H = None if H is None else as_tensor("H", H, "(B,N,N)").to(f)
        start = None if start is None else as_tensor("start", start, "(B,N)").to(f)
        check_call(self.offset.to(f) if H is None else H, f, start, _NAME, self.box[0])
        z = v = self._clip((torch.zeros_like(f) if start is None else start).to(self.minus_step))
        if H is not None:
            return self._with_own(f, H if H.ndim == 3 else H.expand(len(f), -1, -1), z)
        constant = (f @ self.offset.to(f)).to(z)

        def step(v: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
            v = torch.addmm(torch.addmm(constant, v, self.minus_step), z, self.double_step)
            return v, self._clip(v)

        return fixed_loop(step, self.steps, (v, z))[1]

    def _with_own(self, f: Tensor, H: Tensor, z: Tensor) -> Tensor:
        identity = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
        diagonal = (H * identity).sum(1, keepdim=True)  # (B,1,N)
        diagonal = torch.maximum(diagonal, _SMALLEST_DIAGONAL * diagonal.amax(2, keepdim=True)).clamp(min=1e-12)
        scale = diagonal.rsqrt()
        scales = scale.mT * scale
        offset = -RELAXATION * scales * newton_inverse((H * scales).to(z), self.rho, self._doublings).to(H)
        minus_step = (self.rho * diagonal.mT * offset + identity).to(z)
        double_step = (2 - RELAXATION) * identity.to(z) - 2 * minus_step
        z = v = z[:, None]
        for steps in self._stretches():
            w = z.to(H)
            constant = ((f[:, None] + w @ H) @ offset + w @ minus_step.to(H) + (RELAXATION - 1) * w).to(z)
            v, z = fixed_loop(partial(self._step, constant, minus_step, double_step), steps, (v, z))
        return z[:, 0]

    def _step(
        self, constant: Tensor, minus_step: Tensor, double_step: Tensor, v: Tensor, z: Tensor
    ) -> tuple[Tensor, Tensor]:
        v = constant + v @ minus_step + z @ double_step
        return v, self._clip(v)

    def _clip(self, v: Tensor) -> Tensor:
        return v.clamp(*(bound.to(v) if isinstance(bound, Tensor) else bound for bound in self.box))

    def _stretches(self) -> list[int]:
        """The steps between one forming of the constant and the next."""
        marks = [0, *(round(fraction * self.steps) for fraction in _FORMED_AGAIN), self.steps]
        return [after - before for before, after in pairwise(marks)]

    def extra_repr(self) -> str:
        return f"{len(self.offset)} variables, {self.steps} steps, rho={self.rho:g}"


def newton_inverse(matrix: Tensor, rho: float, doublings: int) -> Tensor:
    r"""The inverses (B,N,N) of :math:`M + \rho I` for matrices of a unit diagonal, by products alone, which double
    the digits ``doublings`` times."""
    size = matrix.shape[-1]
    identity = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
    A = matrix + rho * identity
    X = _START * identity / A.square().sum((1, 2), keepdim=True).sqrt()
    # Each doubles the digits once the smallest eigenvalue, rho over a norm of at most N, has come to 1.
    count = doublings + (size - 1).bit_length()
    return fixed_loop(lambda X: (X @ (2 * identity - A @ X),), count, (X,))[0]


def fixed_loop(step: Callable[..., tuple[Tensor, ...]], count: int, carried: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Some calls of a function of tensors, each on what the one before gave; exported as one ``Loop``."""
    if count == 0 or not torch.compiler.is_exporting():
        for _ in range(count):  # each needs the one before
            carried = step(*carried)
        return carried
    # A loop takes no tensor twice, nor two that share memory.
    counted = (torch.zeros((), dtype=torch.int64), *(value.clone() for value in carried))
    found: tuple[Tensor, ...] = torch.while_loop(
        lambda done, *_: done < count, lambda done, *rest: (done + 1, *step(*rest)), counted
    )
    return found[1:]
