"""A mixture of Gaussians with full covariances, fitted by expectation maximisation."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchface.capture.priors.parzen_window import checked_samples, checked_sizes
from torchface.errors import ShapeError, ValueRangeError

_MAX_ITERATIONS, _TOLERANCE = 200, 1e-5


class GaussianMixture(nn.Module):
    r"""Gaussians with covariances of their own.

    .. math:: p(x) = \sum_{k=1}^{K} \pi_k \, N(x \mid \mu_k, \Sigma_k)

    Args:
        means: (K,D).
        factors: L with :math:`\Sigma_k^{-1} = L_k L_k^\top`, lower triangular, (K,D,D).
        log_mixing_weights: :math:`\log \pi_k`, (K,).

    Example:
        >>> clusters = torch.tensor([[0.0, 0.0], [5.0, 5.0]]).repeat(50, 1)
        >>> clusters += 0.1 * torch.randn(100, 2, generator=torch.Generator().manual_seed(0))
        >>> GaussianMixture.fit(clusters, components=2).means.abs().round().sort(0).values.tolist()
        [[0.0, 0.0], [5.0, 5.0]]
    """

    means: Tensor
    factors: Tensor
    log_mixing_weights: Tensor

    def __init__(self, means: Tensor, factors: Tensor, log_mixing_weights: Tensor) -> None:
        super().__init__()
        count, dimensions = means.shape
        if factors.shape != (count, dimensions, dimensions) or log_mixing_weights.shape != (count,):
            raise ShapeError(
                f"Gaussian mixture: found means {tuple(means.shape)}, factors {tuple(factors.shape)}, "
                f"log_mixing_weights {tuple(log_mixing_weights.shape)}, expected (K,D), (K,D,D), (K,)"
            )
        for name, value in (("means", means), ("factors", factors), ("log_mixing_weights", log_mixing_weights)):
            self.register_buffer(name, value.detach().float())

    @classmethod
    def fit(
        cls, samples: Tensor | Iterable[Tensor], components: int = 1, floor: float = 1e-4, seed: int = 0
    ) -> "GaussianMixture":
        """One Gaussian in closed form, several by scikit-learn's expectation maximisation from k-means, in float64.

        Args:
            samples: weights, (T,D); or parts of them, of which one Gaussian is learned in two passes, several from all
                at once.
            components: K.
            floor: added to each variance.
            seed: of the k-means.

        Raises:
            ShapeError: fewer samples than components, or fewer than two; or no parts.
            ValueRangeError: NaN, or settings out of range.
        """
        if components < 1 or not floor > 0:
            raise ValueRangeError(
                f"Gaussian mixture: found {components} components and floor {floor}, expected at least one, and a "
                "positive variance"
            )
        parts: Iterable[Tensor] = (checked_samples(samples),) if isinstance(samples, Tensor) else samples
        if components == 1:
            return cls._single(parts, floor)
        together = torch.cat(list(parts))
        if len(together) < components:
            raise ShapeError(f"samples: found {tuple(together.shape)}, expected (T,D) with at least {components}")
        from sklearn.mixture import GaussianMixture as Fitted  # takes a second, and only training needs it

        fitted = Fitted(components, reg_covar=floor, tol=_TOLERANCE, max_iter=_MAX_ITERATIONS, random_state=seed)
        fitted.fit(together.detach().cpu().double().numpy())
        means, precisions, weights = map(torch.from_numpy, (fitted.means_, fitted.precisions_, fitted.weights_))
        return cls(means, torch.linalg.cholesky(precisions), weights.log())

    @classmethod
    def _single(cls, parts: Iterable[Tensor], floor: float) -> "GaussianMixture":
        count, total = 0, torch.zeros(())
        for part in parts:
            count, total = count + len(part), total + part.detach().double().sum(0)
        if not count:
            raise ShapeError("samples: found none, expected parts (T,D)")
        mean, scatter = total / count, torch.zeros(())
        for part in parts:
            away = part.detach().double() - mean
            scatter = scatter + away.T @ away
        covariance = scatter / count
        covariance.diagonal().add_(floor)
        precision = torch.cholesky_inverse(torch.linalg.cholesky(covariance))
        return cls(mean[None], torch.linalg.cholesky(precision)[None], torch.zeros(1))

    def log_density(self, samples: Tensor) -> Tensor:
        """:math:`\\log p` of samples (B,D), (B,)."""
        return self._log_joint(samples).logsumexp(1)

    def bound(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        r"""A quadratic that touches :math:`-\log p` at samples (B,D) and lies above it everywhere else.

        With the responsibilities :math:`r_k` of the Gaussians there:
        :math:`\sum_k r_k \tfrac12 (x - \mu_k)^\top \Sigma_k^{-1} (x - \mu_k)` and a constant.

        Returns:
            H (B,D,D) and f (B,D) of :math:`\tfrac12 x^\top H x + f^\top x`.
        """
        responsibilities = self._log_joint(samples).softmax(1)
        factors = self.factors.to(samples)
        precision = factors @ factors.transpose(1, 2)
        pulled = (precision @ self.means.to(samples)[..., None])[..., 0]
        return (responsibilities @ precision.flatten(1)).unflatten(1, precision.shape[1:]), -responsibilities @ pulled

    def mapped(self, matrix: Tensor, floor: Tensor) -> "GaussianMixture":
        """The density of y = Mx with a variance added to each y; see ``StudentDensity.mapped``."""
        factors, matrix = self.factors.double(), matrix.to(self.factors.device).double()
        covariance = matrix @ torch.cholesky_inverse(torch.linalg.cholesky(factors @ factors.mT)) @ matrix.T
        covariance.diagonal(dim1=1, dim2=2).add_(floor.to(covariance))
        precision = torch.cholesky_inverse(torch.linalg.cholesky(covariance))
        return GaussianMixture(
            self.means.double() @ matrix.T, torch.linalg.cholesky(precision), self.log_mixing_weights
        )

    def _log_joint(self, samples: Tensor) -> Tensor:
        """:math:`\\log \\pi_k N(x \\mid \\mu_k, \\Sigma_k)`, (B,K)."""
        factors, means = self.factors.to(samples), self.means.to(samples)
        whitened = torch.einsum("bkd,kde->bke", samples[:, None] - means, factors)
        volume = factors.diagonal(dim1=1, dim2=2).log().sum(1)
        constant = 0.5 * samples.shape[1] * math.log(2 * math.pi)
        return self.log_mixing_weights.to(samples) + volume - constant - 0.5 * whitened.square().sum(-1)

    @property
    def config(self) -> dict[str, Any]:
        """Sizes from which :meth:`from_config` makes a density for the state to be loaded into."""
        return {"kind": "mixture", "components": len(self.means), "dimensions": self.means.shape[1]}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "GaussianMixture":
        """A density with the sizes of a ``config``.

        Raises:
            FileFormatError: a size is missing or too large.
        """
        count, dimensions = checked_sizes(config, "components", "dimensions")
        checked_sizes({**config, "square": dimensions}, "components", "dimensions", "square")
        return cls(torch.zeros(count, dimensions), torch.zeros(count, dimensions, dimensions), torch.zeros(count))
