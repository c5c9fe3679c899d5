"""Derivatives of a constrained quadratic program's solution, apart from the solver that found it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchface.optim.box_problem import metric
from torchface.optim.free_variables import solve_free


class BoxSolution(torch.autograd.Function):
    r"""The solution as a differentiable function of H and f.

    Bounds that hold at the solution hold in a neighbourhood of H and f (strict complementarity), so there it is
    :math:`x_F = -H_{FF}^{-1} (f_F + H_{FA} x_A)` with :math:`x_A` fixed, and

    .. math:: dx_F = -H_{FF}^{-1} (dH\,x + df)_F, \qquad dx_A = 0.

    With :math:`v = \partial L/\partial x` and :math:`s_F = H_{FF}^{-1} v_F`, :math:`s_A = 0`:

    .. math:: \partial L/\partial f = -s, \qquad \partial L/\partial H = -\tfrac12 (s x^\top + x s^\top),

    the second symmetrised because H only acts through its symmetric part. One H for all problems collects their sum.

    Source: Amos and Kolter 2017, OptNet, specialised to a box.
    """

    @staticmethod
    def forward(ctx: Any, H: Tensor, f: Tensor, lower: Tensor, upper: Tensor, solve: Callable[[], Tensor]) -> Tensor:
        x = solve()
        ctx.save_for_backward(H, x, lower, upper)
        return x

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        H, x, lower, upper = ctx.saved_tensors
        exact = H.detach().double()
        exact = 0.5 * (exact + exact.transpose(-1, -2))
        wide = x.double()
        free = (x > lower.to(x)) & (x < upper.to(x))
        s = solve_free(exact, metric(exact), free, gradients[0].double())
        to_H = to_f = None
        if ctx.needs_input_grad[0]:
            outer = s.T @ wide if H.ndim == 2 else s[:, :, None] * wide[:, None, :]
            to_H = (-0.5 * (outer + outer.transpose(-1, -2))).to(H.dtype)
        if ctx.needs_input_grad[1]:
            to_f = (-s).to(x.dtype)
        return to_H, to_f, None, None, None


class SimplexSolution(torch.autograd.Function):
    r"""The solution on the simplex as a differentiable function of H and f.

    Variables that take part keep to the sum, :math:`H_{AA} x_A + f_A = \mu \mathbf 1`, :math:`\mathbf 1^\top x_A = 1`,
    and the others stay 0. With :math:`v = \partial L/\partial x` and s the solution of

    .. math:: \begin{pmatrix} H_{AA} & \mathbf 1 \\ \mathbf 1^\top & 0 \end{pmatrix}
        \begin{pmatrix} s_A \\ \cdot \end{pmatrix} = \begin{pmatrix} v_A \\ 0 \end{pmatrix}

    derivatives are those of ``BoxSolution``.

    Source: Amos and Kolter 2017, OptNet, specialised to a simplex.
    """

    @staticmethod
    def forward(ctx: Any, H: Tensor, f: Tensor, solve: Callable[[], Tensor]) -> Tensor:
        x = solve()
        ctx.save_for_backward(H, x)
        return x

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        H, x = ctx.saved_tensors
        exact = H.detach().double()
        exact = 0.5 * (exact + exact.transpose(-1, -2))
        wide, taken = x.double(), x > 0
        v = gradients[0].double().masked_fill(~taken, 0.0)
        spread = metric(exact)
        tangent = solve_free(exact, spread, taken, taken.to(wide))
        s = solve_free(exact, spread, taken, v)
        s = s - tangent * (s.sum(1) / tangent.sum(1))[:, None]
        to_H = to_f = None
        if ctx.needs_input_grad[0]:
            outer = s.T @ wide if H.ndim == 2 else s[:, :, None] * wide[:, None, :]
            to_H = (-0.5 * (outer + outer.transpose(-1, -2))).to(H.dtype)
        if ctx.needs_input_grad[1]:
            to_f = (-s).to(x.dtype)
        return to_H, to_f, None
