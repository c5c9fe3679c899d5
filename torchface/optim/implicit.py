"""Derivatives of what a constrained quadratic program or an iteration finds, apart from the solver that found it."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchface.errors import TraceError
from torchface.optim.box_problem import metric
from torchface.optim.free_variables import RIDGE, solve_free

Solve = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]  # of H, f and the bounds, tensors that no transform wraps


class BoxSolution(torch.autograd.Function):
    r"""The solution as a differentiable function of H and f.

    Bounds that hold at the solution hold in a neighbourhood of H and f (strict complementarity), so there it is
    :math:`x_F = -H_{FF}^{-1} (f_F + H_{FA} x_A)` with :math:`x_A` fixed, and

    .. math:: dx_F = -H_{FF}^{-1} (dH\,x + df)_F, \qquad dx_A = 0.

    With :math:`v = \partial L/\partial x` and :math:`s_F = H_{FF}^{-1} v_F`, :math:`s_A = 0`:

    .. math:: \partial L/\partial f = -s, \qquad \partial L/\partial H = -\tfrac12 (s x^\top + x s^\top),

    the second symmetrised because H only acts through its symmetric part. One H for all problems collects their sum.
    Derivatives of derivatives are those of these formulas, in which the free variables stay the same ones. The form is
    what the transforms of ``torch.func`` ask for: what ``vmap`` goes along joins the batch.

    Source: Amos and Kolter 2017, OptNet, specialised to a box.
    """

    @staticmethod
    def forward(H: Tensor, f: Tensor, lower: Tensor, upper: Tensor, solve: Solve) -> Tensor:
        return solve(H, f, lower, upper)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        H, _, lower, upper, _ = inputs
        ctx.save_for_backward(H, output, lower, upper)
        ctx.save_for_forward(H, output, lower, upper)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        H, x, lower, upper = ctx.saved_tensors
        s = _FreeSolution.apply(_symmetric(H.double()), _free(x, lower, upper), gradients[0].double())
        to_H = -_by_matrix(s, x.double(), H).to(H.dtype) if ctx.needs_input_grad[0] else None
        return to_H, -s.to(x.dtype), None, None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        H, x, lower, upper = ctx.saved_tensors
        moved = _times(_symmetric(tangents[0].double()), x.double()) + tangents[1].double()
        return -_FreeSolution.apply(_symmetric(H.double()), _free(x, lower, upper), moved).to(x.dtype)

    @staticmethod
    def vmap(
        info: Any, dims: tuple[int | None, ...], H: Tensor, f: Tensor, lower: Tensor, upper: Tensor, solve: Solve
    ) -> tuple[Tensor, int]:
        """A batch of batches is one batch."""
        if dims[2] is not None or dims[3] is not None:
            raise TraceError("box_qp: found bounds that vmap goes along, expected the same ones for all")
        f = _in_front(f, dims[1], info.batch_size)
        H = _one_each(H, dims[0], info.batch_size, f.shape[1])
        x: Tensor = BoxSolution.apply(H, f.flatten(0, 1), lower, upper, solve)
        return x.unflatten(0, f.shape[:2]), 0


def free_step(H: Tensor, f: Tensor, x: Tensor, free: Tensor) -> Tensor:
    r"""The step :math:`-H_{FF}^{-1} (Hx + f)_F` of free variables, 0 elsewhere, (B,N), with derivatives of any order.

    It carries the derivatives of :math:`x_F`, which the solution x (B,N) itself is given without.
    """
    exact = _symmetric(H.double())
    slope = torch.where(free, _times(exact, x.double()) + f.double(), 0.0)
    if not (torch.compiler.is_compiling() or torch.compiler.is_exporting()):
        solved: Tensor = _FreeSolution.apply(exact, free, slope)
        return -solved.to(x.dtype)
    # The same of operations that a graph can hold.
    both = free[..., :, None] & free[..., None, :]
    lifted = torch.where(both, exact, 0.0) + torch.diag_embed(torch.where(free, RIDGE * metric(exact), 1.0))
    return -torch.linalg.solve(lifted, slope[..., None])[..., 0].to(x.dtype)


class _FreeSolution(torch.autograd.Function):
    r"""The solutions s of :math:`H_{FF} s_F = v_F`, :math:`s_A = 0`, float64, with all their derivatives.

    With :math:`w = \partial L/\partial s` and :math:`t_F = H_{FF}^{-1} w_F`: :math:`\partial L/\partial v = t`,
    :math:`\partial L/\partial H = -\tfrac12 (t s^\top + s t^\top)`.
    """

    @staticmethod
    def forward(H: Tensor, free: Tensor, v: Tensor) -> Tensor:
        return solve_free(H, metric(H), free, v)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        H, free, _ = inputs
        ctx.save_for_backward(H, free, output)
        ctx.save_for_forward(H, free, output)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, None, Tensor]:
        H, free, s = ctx.saved_tensors
        t = _FreeSolution.apply(H, free, gradients[0])
        return -_by_matrix(t, s, H) if ctx.needs_input_grad[0] else None, None, t

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        H, free, s = ctx.saved_tensors
        moved: Tensor = _FreeSolution.apply(H, free, tangents[2] - _times(_symmetric(tangents[0]), s))
        return moved

    @staticmethod
    def vmap(info: Any, dims: tuple[int | None, ...], H: Tensor, free: Tensor, v: Tensor) -> tuple[Tensor, int]:
        free, v = (_in_front(rows, dim, info.batch_size) for rows, dim in ((free, dims[1]), (v, dims[2])))
        H = _one_each(H, dims[0], info.batch_size, v.shape[1])
        s: Tensor = _FreeSolution.apply(H, free.flatten(0, 1), v.flatten(0, 1))
        return s.unflatten(0, v.shape[:2]), 0


def _free(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    return (x > lower.to(x)) & (x < upper.to(x))


def _symmetric(H: Tensor) -> Tensor:
    return 0.5 * (H + H.transpose(-1, -2))


def _times(H: Tensor, x: Tensor) -> Tensor:
    """Products with (B,N) of a symmetric H, (N,N) or (B,N,N)."""
    return x @ H if H.ndim == 2 else (H @ x[..., None])[..., 0]


def _by_matrix(s: Tensor, x: Tensor, H: Tensor) -> Tensor:
    """The symmetric part of the products of rows (B,N), summed where one H (N,N) is of all problems."""
    return _symmetric(s.T @ x if H.ndim == 2 else s[:, :, None] * x[:, None, :])


def _in_front(values: Tensor, dim: int | None, count: int) -> Tensor:
    """With the dimension that vmap goes along first."""
    return values.expand(count, *values.shape) if dim is None else values.movedim(dim, 0)


def _one_each(H: Tensor, dim: int | None, count: int, problems: int) -> Tensor:
    """One matrix for all, (N,N), or one for each problem of each batch, (K*B,N,N)."""
    if dim is None and H.ndim == 2:
        return H
    H = _in_front(H, dim, count)
    return (H[:, None].expand(-1, problems, -1, -1) if H.ndim == 3 else H).flatten(0, 1)


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
        exact = _symmetric(H.detach().double())
        wide, taken = x.double(), x > 0
        v = gradients[0].double().masked_fill(~taken, 0.0)
        spread = metric(exact)
        tangent = solve_free(exact, spread, taken, taken.to(wide))
        s = solve_free(exact, spread, taken, v)
        s = s - tangent * (s.sum(1) / tangent.sum(1))[:, None]
        to_H = -_by_matrix(s, wide, H).to(H.dtype) if ctx.needs_input_grad[0] else None
        return to_H, -s.to(x.dtype), None


def attach_gradients(gradient: Callable[[Tensor], Tensor], solution: Tensor, free: Tensor) -> Tensor:
    r"""A solution (B,D) that was found without gradients, as a differentiable function of what the problem is made of.

    Free variables satisfy :math:`g(x, \theta)_F = 0`, the others stay at their bounds, so
    :math:`dx_F = -(\partial g / \partial x)_{FF}^{-1} (\partial g / \partial \theta)_F \, d\theta`: one Newton step
    from the solution, whose matrix is held constant. All second derivatives count, not Gauss-Newton's alone.

    Args:
        gradient: g, of (B,D) to (B,D), each row of its own; built of differentiable operations on :math:`\theta`.
        solution: (B,D).
        free: variables inside their bounds, (B,D) bool.

    Source: the implicit function theorem; Amos and Kolter 2017 for bounds.
    """
    here = solution.detach()
    probe = here.clone().requires_grad_()
    rows = gradient(probe)
    # Rows do not mix, so the derivatives of all of them come with one backward pass a column.
    columns = [torch.autograd.grad(rows[:, i].sum(), probe, retain_graph=True)[0] for i in range(rows.shape[1])]
    both = free[:, :, None] & free[:, None, :]
    identity = torch.eye(here.shape[1], dtype=here.dtype, device=here.device)
    slope = torch.where(both, torch.stack(columns, dim=1).detach(), identity)
    rest = torch.where(free, gradient(here), 0.0)
    return here - torch.linalg.solve(slope, rest[..., None])[..., 0]
