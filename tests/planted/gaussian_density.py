"""One Gaussian with full covariance as a shape prior's density: the peer that learned densities have to beat."""

from typing import Any

import torch
from torch import Tensor, nn


def gaussian(samples: Tensor, variance: float = 1e-4) -> Any:
    """The Gaussian of weights (T,D), with a variance added to each."""
    x = samples.detach().double()
    covariance = torch.cov(x.T, correction=0).reshape(x.shape[1], x.shape[1])
    return GaussianDensity(x.mean(0), torch.linalg.inv(covariance + variance * torch.eye(x.shape[1]).double()))


class GaussianDensity(nn.Module):
    """As ``StudentDensity``, of a mean (D) and a precision (D,D)."""

    mean: Tensor
    precision: Tensor

    def __init__(self, mean: Tensor, precision: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("precision", precision)

    def log_density(self, samples: Tensor) -> Tensor:
        mean, precision = self.mean.to(samples), self.precision.to(samples)
        return torch.distributions.MultivariateNormal(mean, precision_matrix=precision).log_prob(samples)

    def bound(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        mean, precision = self.mean.to(samples), self.precision.to(samples)
        return precision.expand(len(samples), -1, -1), -(precision @ mean).expand(len(samples), -1)
