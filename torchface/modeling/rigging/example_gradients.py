"""The shapes' half of example-based rigging: what examples add to a prior, triangle by triangle."""

import torch
from torch import Tensor

_NUMBERS_AT_ONCE = 2**23


def shape_stiffness(changes: Tensor, kappa: float, theta: float) -> Tensor:
    r"""How firmly each triangle of a shape holds to the prior, (N,F): much where the template hardly deforms.

    .. math:: w_i = \left(\frac{1 + \lVert G_i - I \rVert_F}{\kappa + \lVert G_i - I \rVert_F}\right)^\theta

    Args:
        changes: :math:`G_i - I`, the template's gradients without unit, (N,F,3,3).
        kappa: where stiffness levels off; :math:`\kappa^{-\theta}` is the highest.
        theta: how steeply it falls, to 1 where a triangle deforms strongly.

    Source: thesis 3.3.3, below equation 28; Li, Weise and Pauly 2010.
    """
    size = changes.flatten(2).norm(dim=-1)
    return ((1 + size) / (kappa + size)) ** theta


def example_shares(residuals: Tensor, weights: Tensor, compliance: Tensor) -> Tensor:
    r"""What each example adds, X (M,F,K), once what shapes share among them is taken out.

    .. math:: \min_D \sum_j \lVert R_j - \sum_i \alpha_{ji} D_i \rVert^2 + \sum_i c_i^{-1} \lVert D_i \rVert^2

    has the minimiser :math:`D_i = c_i \sum_j \alpha_{ji} X_j` with :math:`X = (A C A^\top + I)^{-1} R`, by Woodbury's
    identity: a system of the size of the examples and not of the shapes, for each triangle by itself.

    Args:
        residuals: R, what the prior leaves of each example, (M,F,K).
        weights: A, :math:`\alpha`, (M,N).
        compliance: :math:`c = 1 / (\beta w)`, (N,F); a shape that an element may not change in has 0 there.

    Source: thesis 3.3.3, equations 27 and 28.
    """
    count, elements, size = residuals.shape
    shares = torch.empty_like(residuals)
    identity = torch.eye(count, dtype=residuals.dtype, device=residuals.device)
    step = max(1, _NUMBERS_AT_ONCE // (count * (count + size)))
    products = (weights[:, None] * weights[None]).flatten(0, 1)
    for first in range(0, elements, step):  # a loop over chunks that memory holds
        chunk = slice(first, first + step)
        system = (products @ compliance[:, chunk]).T.reshape(-1, count, count) + identity
        solved = torch.cholesky_solve(residuals[:, chunk].transpose(0, 1), torch.linalg.cholesky(system))
        shares[:, chunk] = solved.transpose(0, 1)
    return shares


def personal_part(shares: Tensor, weights: Tensor, compliance: Tensor) -> Tensor:
    r"""What some of the shapes take up, :math:`D_i = c_i \sum_j \alpha_{ji} X_j`, (G,F,K).

    Args:
        shares: X, (M,F,K).
        weights: of these shapes in the examples, (M,G).
        compliance: of these shapes, (G,F).
    """
    return compliance[..., None] * torch.einsum("mg,mfk->gfk", weights, shares)
