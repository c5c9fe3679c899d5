"""Gaussian processes with inducing points, ready to predict with plain tensors."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError

# Directions of the inducing points that the kernel distinguishes by less than this are left out: float32 cannot.
_MIN_EIGENVALUE = 1e-6


def squared_distances(first: Tensor, second: Tensor) -> Tensor:
    """(...,A,F) and (...,B,F) to (...,A,B), by one product.

    ``torch.cdist`` has wrong derivatives under ``torch.func.jacrev``.

    Example:
        >>> squared_distances(torch.tensor([[0.0, 0.0]]), torch.tensor([[3.0, 4.0], [0.0, 1.0]])).tolist()
        [[25.0, 1.0]]
    """
    lengths = first.square().sum(-1, keepdim=True) + second.square().sum(-1)[..., None, :]
    return (lengths - 2 * first @ second.transpose(-1, -2)).clamp(min=0.0)


@dataclass(frozen=True, eq=False)
class Kernel:
    r"""The kernel of one process, with the noise of what it learns from.

    .. math:: k(x, x') = \theta_0 \exp\Big(-\tfrac12 \sum_d \frac{(x_d - x'_d)^2}{\ell_d^2}\Big)

    Source: thesis 4.2.10, equations 58 and 59, with a length for each input.
    """

    signal: float  # \theta_0
    inverse_lengths: Tensor  # 1/\ell_d, (F,); 0 for inputs that it does not use
    noise: float  # \beta^{-1}, the variance of targets around the function

    def between(self, first: Tensor, second: Tensor) -> Tensor:
        """k of inputs (A,F) and (B,F), (A,B)."""
        scaled = [inputs * self.inverse_lengths.to(inputs) for inputs in (first, second)]
        return self.signal * torch.exp(-0.5 * squared_distances(*scaled))


class GaussianProcesses(nn.Module):
    r"""G independent processes over the same inputs, each for some of N targets.

    With :math:`\Phi = k(X,Z) K_{ZZ}^{-1/2}` the inducing points Z approximate all inputs X, and a process predicts

    .. math:: m(x) = k(x,Z) K_{ZZ}^{-1/2} (\Phi^\top\Phi + \beta^{-1} I)^{-1} \Phi^\top t, \qquad
        \sigma^2(x) = \theta_0 - k(x,Z) \big(K_{ZZ}^{-1} - K_{ZZ}^{-1/2}(\beta\,\Phi^\top\Phi + I)^{-1} K_{ZZ}^{-1/2}
        \big) k(Z,x)

    which is equations 62 and 63 where Z = X. The variance is that of the function, without the noise of targets.

    Args:
        inverse_lengths: (G,F).
        inducing: Z times the inverse lengths, (G,M,F).
        signal: (G,).
        whitening: :math:`K_{ZZ}^{-1/2}`, (G,M,M).
        covariance_root: R with :math:`R R^\top = K_{ZZ}^{-1/2}(\beta\,\Phi^\top\Phi + I)^{-1} K_{ZZ}^{-1/2}`, (G,M,M).
        weights: what R's columns add to the mean, (G,M,N).

    Source: thesis 4.2.10, equations 60 to 63; Titsias 2009 for the inducing points.
    """

    inverse_lengths: Tensor
    inducing: Tensor
    signal: Tensor
    whitening: Tensor
    covariance_root: Tensor
    weights: Tensor

    def __init__(
        self,
        inverse_lengths: Tensor,
        inducing: Tensor,
        signal: Tensor,
        whitening: Tensor,
        covariance_root: Tensor,
        weights: Tensor,
    ) -> None:
        super().__init__()
        groups, points, inputs = inducing.shape
        expected = {
            "inverse_lengths": (inverse_lengths, (groups, inputs)),
            "inducing": (inducing, (groups, points, inputs)),
            "signal": (signal, (groups,)),
            "whitening": (whitening, (groups, points, points)),
            "covariance_root": (covariance_root, (groups, points, points)),
            "weights": (weights, (groups, points, weights.shape[-1])),
        }
        for name, (value, shape) in expected.items():
            if tuple(value.shape) != shape:
                raise ShapeError(f"Gaussian processes: found {name} {tuple(value.shape)}, expected {shape}")
            self.register_buffer(name, value.detach())

    @classmethod
    def stacked(cls, learned: "list[Posterior]", kernels: list[Kernel]) -> "GaussianProcesses":
        """Processes that were learned one by one."""
        return cls(
            torch.stack([kernel.inverse_lengths for kernel in kernels]),
            torch.stack([one.inducing for one in learned]),
            torch.tensor([kernel.signal for kernel in kernels], dtype=learned[0].inducing.dtype),
            torch.stack([one.whitening for one in learned]),
            torch.stack([one.covariance_root for one in learned]),
            torch.stack([one.weights for one in learned]),
        )

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """The mean (B,N) of all targets, and the variance (B,G) of each process' function, in units of the signal."""
        scaled = inputs * self.inverse_lengths[:, None]
        near = self.signal[:, None, None] * torch.exp(-0.5 * squared_distances(scaled, self.inducing))
        projected = near @ self.covariance_root
        explained = (near @ self.whitening).square().sum(-1)
        variance = (self.signal[:, None] - explained).clamp(min=0.0) + projected.square().sum(-1)
        return (projected @ self.weights).sum(0), variance.T


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior of one process; fields as of :class:`GaussianProcesses`, for one."""

    inducing: Tensor
    whitening: Tensor
    covariance_root: Tensor
    weights: Tensor


@dataclass(frozen=True, eq=False)
class Statistics:
    """Sufficient statistics: sums over frames, so that takes can be added and left out."""

    square: Tensor  # \\Phi^\\top\\Phi, (M,M)
    product: Tensor  # \\Phi^\\top t, (M,N)

    def __add__(self, other: "Statistics") -> "Statistics":
        return Statistics(self.square + other.square, self.product + other.product)


def whitening_of(kernel: Kernel, inducing: Tensor) -> Tensor:
    """:math:`K_{ZZ}^{-1/2}` (M,M), in float64, without the directions in which K is all but singular."""
    values, vectors = torch.linalg.eigh(kernel.between(inducing, inducing))
    kept = values > _MIN_EIGENVALUE * values[-1]
    root = torch.where(kept, values.clamp(min=1e-300).rsqrt(), torch.zeros_like(values))
    return (vectors * root) @ vectors.T


def posterior(
    kernel: Kernel, inducing: Tensor, whitening: Tensor, statistics: Statistics, redundancy: float
) -> Posterior:
    """The posterior of a process given its frames' statistics; so many correlated frames as ``redundancy`` count as
    one."""
    noise = kernel.noise * redundancy
    eye = torch.eye(len(inducing), dtype=inducing.dtype)
    factor = torch.linalg.cholesky(statistics.square / noise + eye)
    root = torch.linalg.solve_triangular(factor, eye, upper=False).T
    weights = root.T @ statistics.product / noise
    return Posterior(inducing * kernel.inverse_lengths, whitening, whitening @ root, weights)
