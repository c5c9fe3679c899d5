"""Box-constrained quadratic programs by a fixed number of splitting's steps: one module for PyTorch and for ONNX."""

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor, nn

from torchface.number_checks import checked_count, checked_number
from torchface.optim.full_precision import full_precision
from torchface.optim.operator_splitting import RELAXATION, RHO, prepare_splitting

STEPS = 66
_SMALLEST_DIAGONAL = 1e-6  # a share of the largest; smaller ones would overflow the scaling
# Shares of the steps after which the constant is formed again from the gradient: early, so that what the inverse's
# rounding left behind in slow modes is gone at the end.
_FORMED_AGAIN = (0.09, 0.27)
_START = 1.5  # of Newton's iteration, over a norm; below 2 it converges


class FixedSplitting(nn.Module):
    r"""Solves box QPs to within some millionths by matrix products and clamps alone.

    .. math:: \min \tfrac12 x^\top H x + f^\top x,\ l \le x \le u, \qquad
        v' = c - v\,G + z\,(2G + (2 - \alpha) I), \quad z' = \mathrm{clip}(v', l, u)

    A step is that of ``torchface.optim.operator_splitting``, with :math:`t = 2z - v` written out. One H is factored
    here. Problems with an H each take Newton's iteration for the inverse of :math:`A = H + \rho D` scaled to a unit
    diagonal, :math:`X' = X (2I - AX)`: A's condition is at most about :math:`N / \rho`, so a dozen products suffice.

    The constant c is formed in the precision of f, float64, in which a shape that moves markers by hundredths of a
    millimetre is not lost beside others that move them by centimetres; the steps run in that of the buffers, float32.

    Args:
        H: of all problems, (N,N), positive semidefinite; absent if each call brings one a problem.
        lower, upper: the box.
        steps: how many.
        rho: :math:`\rho`, of the metric.

    Raises:
        ValueRangeError: less than one step, or a ``rho`` that is not positive.

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
        self, H: Tensor | None = None, lower: float = 0.0, upper: float = 1.0, steps: int = STEPS, rho: float = RHO
    ) -> None:
        super().__init__()
        checked_count("fixed splitting: steps", steps, 1)
        self.lower, self.upper, self.steps, self.rho = lower, upper, steps, rho
        checked_number("fixed splitting: rho", rho, above=True)
        # A whole number, as a compiled call takes it for a constant.
        self._doublings = math.ceil(math.log2(16 / (_START * rho)))
        offset = step = torch.zeros(0, 0, dtype=torch.float64)
        if H is not None:
            factors = prepare_splitting(H.double(), rho)
            offset, step = factors.offset, factors.step
        double_step = 2 * step
        double_step.diagonal().add_(2 - RELAXATION)
        self.register_buffer("offset", offset)
        self.register_buffer("minus_step", -step.float())
        self.register_buffer("double_step", double_step.float())

    @full_precision
    def forward(self, f: Tensor, H: Tensor | None = None, start: Tensor | None = None) -> Tensor:
        """The solutions, (B,N), in the precision of the buffers.

        Args:
            f: (B,N), float64.
            H: of each problem, (B,N,N), float64; the one given before if absent.
            start: (B,N); zero if absent.
        """
        f = f.to(torch.promote_types(f.dtype, self.minus_step.dtype))
        start = (torch.zeros_like(f) if start is None else start.to(f)).clamp(self.lower, self.upper)
        z = v = start.to(self.minus_step)
        if H is not None:
            return self._with_own(f, H.to(f), z)
        constant = (f @ self.offset.to(f)).to(z)

        def step(v: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
            v = torch.addmm(torch.addmm(constant, v, self.minus_step), z, self.double_step)
            return v, v.clamp(self.lower, self.upper)

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
        return v, v.clamp(self.lower, self.upper)

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
