"""Whether several photographs show one person: the evidence of each alone, compared with the others'."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.modeling.photographs.image_fit import ImageFit

_MIN_VARIANCE = 1e-2  # of a coefficient that lies on its bound, about which the covariance is silent


def same_person(fits: Sequence[ImageFit]) -> Tensor:
    r"""The evidence that a photograph shows the head that the others show, and not any other.

    .. math:: \log \frac{p(q_i, q_{\ne i} \mid \text{one } a)}{p(q_i)\, p(q_{\ne i})}, \qquad a \sim N(0, I)

    with landmarks :math:`q` taken to be Gaussian about each fit's coefficients :math:`a`, expression and camera
    unknown. It is 0 where a photograph holds no evidence, positive where it fits to the others, negative where another
    head explains it better.

    Args:
        fits: one a photograph, each fitted alone with the same model, I of them.

    Returns:
        Natural logarithms of the odds, (I,) float64.

    Source: Prince, Elder 2007 (probabilistic linear discriminant analysis) for the ratio.
    """
    count = len(fits[0].coefficients)
    eye = torch.eye(count, dtype=torch.float64)
    precisions, pulls = [], []
    for fit in fits:  # photographs
        covariance = fit.covariance[:count, :count].double()
        silent = torch.diag((covariance.diagonal() <= 0).double() * _MIN_VARIANCE)
        posterior = torch.linalg.inv(covariance + silent + 1e-9 * eye)
        values, vectors = torch.linalg.eigh(0.5 * (posterior + posterior.T) - eye)
        precisions.append((vectors * values.clamp(min=0)) @ vectors.T)
        pulls.append(posterior @ fit.coefficients.double())
    information, pull = torch.stack(precisions), torch.stack(pulls)
    together = _log_evidence(information.sum(0), pull.sum(0))
    return torch.stack([
        together - _log_evidence(one, own) - _log_evidence(information.sum(0) - one, pull.sum(0) - own)
        for one, own in zip(information, pull, strict=True)
    ])  # fmt: skip


def _log_evidence(precision: Tensor, pull: Tensor) -> Tensor:
    """Relative to landmarks that hold no evidence."""
    whole = precision + torch.eye(len(pull), dtype=torch.float64)
    return 0.5 * pull @ torch.linalg.solve(whole, pull) - 0.5 * torch.logdet(whole)
