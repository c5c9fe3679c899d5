r"""Operator splitting for box-constrained quadratic programs: matrix products and clamps only.

One step of the alternating direction method in the metric :math:`\rho D`, :math:`D = \mathrm{diag} H`, over-relaxed by
:math:`\alpha`, with z the clipped and u the scaled dual variable:

.. math::
    y = (H + \rho D)^{-1} (\rho D (z - u) - f), \quad
    v = \alpha y + (1 - \alpha) z + u, \quad
    z' = \mathrm{clip}(v), \quad u' = v - z'

In the variable :math:`t = z - u` everything but the clip is one affine map,
:math:`v = t G + (2 - \alpha) z + c` with :math:`G = \alpha \rho D (H + \rho D)^{-1} - I` and
:math:`c = -\alpha (H + \rho D)^{-1} f`, and :math:`t' = 2 z' - v`: a product, two additions and a clamp a step.

The constant is formed from the gradient g at any point w as
:math:`c = -\alpha (H + \rho D)^{-1} g + w ((\alpha - 1) I - G)`. With g and w in float64 and w near the solution the
steps themselves may run in float32: what they round away is a share of what is left to go, not of f.

Source: Boyd et al. 2011, sections 3.4.3 and 5.2; the diagonal metric takes the place of a scaled H.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.number_checks import checked_count, checked_number
from torchface.optim.box_problem import BoxProblem, metric

# Measured on a real rig of 53 shapes, whose eigenvalues span five decades.
RHO = 0.12
RELAXATION = 1.9


@dataclass(frozen=True, eq=False)
class SplittingFactors:
    """What a step needs of H.

    Args:
        step: :math:`G`, (N,N) or (B,N,N).
        offset: :math:`-\\alpha (H + \\rho D)^{-1}`, (N,N) or (B,N,N).
        relaxation: :math:`\\alpha`.
    """

    step: Tensor
    offset: Tensor
    relaxation: float = RELAXATION

    def rows(self, keep: Tensor) -> SplittingFactors:
        """The factors of some problems; one H serves all."""
        if self.step.ndim == 2:
            return self
        return SplittingFactors(self.step[keep], self.offset[keep], self.relaxation)

    def constant(self, w: Tensor, gradient: Tensor) -> Tensor:
        """:math:`c` from the gradient at w, both (B,N)."""
        return _times(gradient, self.offset) - _times(w, self.step) + (self.relaxation - 1) * w


@dataclass(frozen=True, eq=False)
class SplittingState:
    """Where the iteration stands: clipped z and :math:`t = z - u`, both (B,N)."""

    z: Tensor
    t: Tensor

    def rows(self, keep: Tensor) -> SplittingState:
        return SplittingState(self.z[keep], self.t[keep])


def prepare_splitting(H: Tensor, rho: float = RHO, relaxation: float = RELAXATION) -> SplittingFactors:
    """Factors H (N,N) or (B,N,N), float64.

    Raises:
        ValueRangeError: ``rho`` is not positive, or ``relaxation`` not in (0,2].
    """
    checked_number("prepare_splitting: rho", rho, above=True)
    checked_number("prepare_splitting: relaxation", relaxation, 0.0, 2.0, above=True)
    diagonal = metric(H)
    lifted = H.clone()
    lifted.diagonal(dim1=-2, dim2=-1).add_(rho * diagonal)
    offset = torch.cholesky_inverse(torch.linalg.cholesky(lifted)).mul_(-relaxation)
    step = torch.mul(offset, -rho * diagonal[..., :, None], out=lifted)
    step.diagonal(dim1=-2, dim2=-1).sub_(1)
    return SplittingFactors(step, offset, relaxation)


def start_splitting(problem: BoxProblem, start: Tensor | None) -> SplittingState:
    """The state at ``start`` (B,N), at zero if absent, clipped; its dual is zero.

    A dual guessed from the gradient at ``start`` is no better near the solution and far worse elsewhere.
    """
    z = problem.clip(torch.zeros_like(problem.f) if start is None else start)
    return SplittingState(z, z.clone())


def splitting_steps(
    problem: BoxProblem,
    factors: SplittingFactors,
    state: SplittingState,
    steps: int,
    gradient: Tensor | None = None,
    dtype: torch.dtype = torch.float64,
) -> SplittingState:
    """The state after some steps.

    Args:
        problem: B problems.
        factors: of its H.
        state: where to start.
        steps: how many.
        gradient: of the problem at ``state.z``, (B,N), if it is at hand.
        dtype: in which the steps run; what goes in and comes out is float64.

    Raises:
        ValueRangeError: ``steps`` is negative or no whole number.
    """
    checked_count("splitting_steps: steps", steps)
    gradient = problem.gradient(state.z) if gradient is None else gradient
    constant = factors.constant(state.z, gradient).to(dtype)
    lower, upper, step = problem.lower.to(dtype), problem.upper.to(dtype), factors.step.to(dtype)
    z, t = state.z.to(dtype, copy=True), state.t.to(dtype, copy=True)
    if step.ndim == 3:
        constant, z, t = constant[:, None], z[:, None], t[:, None]
    product = torch.addmm if step.ndim == 2 else torch.baddbmm
    v = torch.empty_like(z)
    for _ in range(steps):
        product(constant, t, step, out=v)
        v.add_(z, alpha=2 - factors.relaxation)
        torch.clamp(v, lower, upper, out=z)
        torch.lerp(v, z, 2.0, out=t)  # 2 z - v
    shape = state.z.shape
    # In float32 a bound may have been rounded to the wrong side of itself.
    return SplittingState(problem.clip(z.view(shape).double()), t.view(shape).double())


def _times(x: Tensor, matrix: Tensor) -> Tensor:
    """x (B,N) by one matrix or by one each."""
    return x @ matrix if matrix.ndim == 2 else torch.bmm(x[:, None], matrix)[:, 0]
