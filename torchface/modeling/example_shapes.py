"""The shapes' half of example-based rigging: what examples say beyond a prior, triangle by triangle."""

from __future__ import annotations

import torch
from torch import Tensor

_NUMBERS_AT_ONCE = 2**23


def shape_stiffness(changes: Tensor, kappa: float, theta: float) -> Tensor:
    r"""How firmly each triangle of a shape holds to the prior: much where the template hardly deforms.

    .. math:: w_i = \left(\frac{1 + \lVert G_i - I \rVert_F}{\kappa + \lVert G_i - I \rVert_F}\right)^\theta

    Args:
        changes: :math:`G_i - I`, the template's gradients without unit, (N,F,3,3).
        kappa: where stiffness levels off; :math:`\kappa^{-\theta}` is the highest.
        theta: how steeply it falls, to 1 where a triangle deforms strongly.

    Returns:
        (N,F).

    Source: thesis 3.3.3, below equation 28; Li, Weise and Pauly 2010.
    """
    size = changes.flatten(2).norm(dim=-1)
    return ((1 + size) / (kappa + size)) ** theta


def personal_gradients(residuals: Tensor, weights: Tensor, compliance: Tensor) -> Tensor:
    r"""What each shape takes up of the examples' residuals.

    .. math:: \min_D \sum_j \lVert R_j - \sum_i \alpha_{ji} D_i \rVert^2 + \sum_i c_i^{-1} \lVert D_i \rVert^2

    for each triangle by itself. By Woodbury's identity
    :math:`D = C A^\top (A C A^\top + I)^{-1} R`, a system of the size of the examples and not of the shapes.

    Args:
        residuals: R, what the prior leaves of each example, (M,F,K).
        weights: A, :math:`\alpha`, (M,N).
        compliance: :math:`c = 1 / (\beta w)`, (N,F); a shape that a triangle may not change in has 0 there.

    Returns:
        D, (N,F,K).

    Source: thesis 3.3.3, equations 27 and 28.
    """
    count, triangles, size = residuals.shape
    found = torch.empty(len(compliance), triangles, size, dtype=residuals.dtype, device=residuals.device)
    identity = torch.eye(count, dtype=residuals.dtype, device=residuals.device)
    step = max(1, _NUMBERS_AT_ONCE // (count * (count + size)))
    products = (weights[:, None] * weights[None]).flatten(0, 1)
    for first in range(0, triangles, step):  # a loop over chunks that memory holds
        chunk = slice(first, first + step)
        system = (products @ compliance[:, chunk]).T.reshape(-1, count, count) + identity
        shares = torch.cholesky_solve(residuals[:, chunk].transpose(0, 1), torch.linalg.cholesky(system))
        found[:, chunk] = compliance[:, chunk, None] * torch.einsum("mn,fmk->nfk", weights, shares)
    return found
