"""Derivatives of where an iteration settled, apart from the iteration."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def attach_gradients(gradient: Callable[[Tensor], Tensor], solution: Tensor, free: Tensor) -> Tensor:
    r"""A solution that was found without gradients, as a differentiable function of what the problem is made of.

    Free variables satisfy :math:`g(x, \theta)_F = 0`, the others stay at their bounds, so
    :math:`dx_F = -(\partial g / \partial x)_{FF}^{-1} (\partial g / \partial \theta)_F \, d\theta`: one Newton step
    from the solution, whose matrix is held constant. All second derivatives count, not Gauss-Newton's alone.

    Args:
        gradient: g, of (B,D) to (B,D), each row of its own; built of differentiable operations on :math:`\theta`.
        solution: (B,D).
        free: variables inside their bounds, (B,D) bool.

    Returns:
        The solution, (B,D).

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
