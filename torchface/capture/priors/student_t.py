"""Student's t-distribution of weights, with its mode at rest."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchface.capture.energy import Quadratic
from torchface.capture.priors.parzen_window import checked_samples, checked_sizes
from torchface.errors import FileFormatError, ShapeError, ValueRangeError

_ITERATIONS = 50
PARTING_VARIANCE = 3e-5  # added to each variance: shapes that always moved together stay distinguishable


class StudentDensity(nn.Module):
    r"""Student's t-distribution in D dimensions, with its mode at rest.

    .. math:: p(x) \propto \Big( 1 + \frac{x^\top \Sigma^{-1} x}{\nu} \Big)^{-(\nu + D)/2}

    Weights do not scatter about their mean: a face keeps coming back to rest, and other takes go further than those
    seen. So the mode is at zero and the tails are heavy: an expression beyond those learned from is drawn back less,
    in all shapes together.

    Args:
        factor: L with :math:`\Sigma^{-1} = L L^\top`, lower triangular, (D,D).
        degrees_of_freedom: :math:`\nu`, positive; a large number for a Gaussian.

    Source: Liu and Rubin 1995 for the fit; Lange, Little and Taylor 1989 for the bound.

    Example:
        >>> density = StudentDensity.fit(torch.randn(500, 1, generator=torch.Generator().manual_seed(0)))
        >>> near, far = density.log_density(torch.tensor([[0.0], [5.0]], dtype=torch.float64)).tolist()
        >>> near > far
        True
    """

    factor: Tensor
    degrees_of_freedom: Tensor

    def __init__(self, factor: Tensor, degrees_of_freedom: float | Tensor) -> None:
        super().__init__()
        if factor.ndim != 2 or factor.shape[0] != factor.shape[1]:
            raise ShapeError(f"Student density: found a factor of {tuple(factor.shape)}, expected (D,D)")
        self.register_buffer("factor", factor.detach().float().contiguous())
        self.register_buffer("degrees_of_freedom", torch.as_tensor(degrees_of_freedom).detach().float().reshape(()))

    @classmethod
    def fit(
        cls, samples: Tensor | Iterable[Tensor], degrees_of_freedom: float = 10.0, floor: float = PARTING_VARIANCE
    ) -> "StudentDensity":
        r"""The likeliest :math:`\Sigma`, by expectation maximisation in float64.

        Args:
            samples: weights, (T,D); or parts of them, finite, that are gone through anew for every iteration, at most
                fifty times: memory is that of the largest.
            degrees_of_freedom: :math:`\nu`.
            floor: added to each variance.

        Raises:
            ShapeError: fewer than two samples, or no parts.
            ValueRangeError: NaN, or settings that are not positive.
        """
        parts: Iterable[Tensor] = (checked_samples(samples),) if isinstance(samples, Tensor) else samples
        if not 0 < degrees_of_freedom < math.inf or not 0 < floor < math.inf:
            raise ValueRangeError(
                f"Student density: found {degrees_of_freedom} degrees of freedom and floor {floor}, "
                "expected positive numbers"
            )
        before: Tensor | None = None
        precision: Tensor | None = None
        for _ in range(_ITERATIONS):  # each iteration needs the weights of the one before
            scatter, count, moved = torch.zeros(()), 0, 0.0
            for part in parts:
                x = part.detach().double()
                weight = _sample_weights(x, precision, degrees_of_freedom)
                if precision is not None:
                    moved = max(moved, float((weight - _sample_weights(x, before, degrees_of_freedom)).abs().max()))
                scatter = scatter.to(x) + (weight[:, None] * x).T @ x
                count += len(x)
            if not count:
                raise ShapeError("samples: found none, expected parts (T,D)")
            if precision is not None and moved < 1e-4:
                break
            covariance = scatter / count
            covariance.diagonal().add_(floor)
            before, precision = precision, torch.cholesky_inverse(torch.linalg.cholesky(covariance))
        assert precision is not None
        return cls(torch.linalg.cholesky(precision), degrees_of_freedom)

    def log_density(self, samples: Tensor) -> Tensor:
        """:math:`\\log p` of samples (B,D), (B,)."""
        factor, nu = self.factor.to(samples), self.degrees_of_freedom.to(samples)
        dimensions = samples.shape[1]
        constant = torch.lgamma(0.5 * (nu + dimensions)) - torch.lgamma(0.5 * nu)
        constant = constant - 0.5 * dimensions * (nu * math.pi).log()
        return constant + factor.diagonal().log().sum() + self.below_peak(samples)

    def below_peak(self, samples: Tensor) -> Tensor:
        """:math:`\\log p` of samples (B,D) less that of their likeliest, (B,)."""
        nu = self.degrees_of_freedom.to(samples)
        distance = (samples @ self.factor.to(samples)).square().sum(1)
        return -0.5 * (nu + samples.shape[1]) * torch.log1p(distance / nu)

    def bound(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        r"""A quadratic that touches :math:`-\log p` at samples (B,D) and lies above it everywhere else.

        The logarithm lies below its tangents: :math:`\frac{\nu + D}{\nu + d^2} \tfrac12 x^\top \Sigma^{-1} x` and a
        constant, d being the distance there.

        Returns:
            H (B,D,D) and f (B,D) of :math:`\tfrac12 x^\top H x + f^\top x`.
        """
        factor, nu = self.factor.to(samples), self.degrees_of_freedom.to(samples)
        distance, precision = (samples @ factor).square().sum(1), factor @ factor.T
        scale = (nu + samples.shape[1]) / (nu + distance)
        return scale[:, None, None] * precision, torch.zeros_like(samples)

    def mapped(self, matrix: Tensor, floor: Tensor) -> "StudentDensity":
        """The density of y = Mx with a variance added to each y.

        Args:
            matrix: M, (E,D).
            floor: (E,), not negative; positive where M makes entries of y depend on each other.
        """
        factor, matrix = self.factor.double(), matrix.to(self.factor.device).double()
        covariance = matrix @ torch.cholesky_inverse(torch.linalg.cholesky(factor @ factor.T)) @ matrix.T
        covariance.diagonal().add_(floor.to(covariance))
        return StudentDensity(
            torch.linalg.cholesky(torch.cholesky_inverse(torch.linalg.cholesky(covariance))), self.degrees_of_freedom
        )

    @property
    def config(self) -> dict[str, Any]:
        """Sizes from which :meth:`from_config` makes a density for the state to be loaded into."""
        return {"kind": "student", "dimensions": len(self.factor)}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "StudentDensity":
        """A density with the sizes of a ``config``.

        Raises:
            FileFormatError: a size is missing or too large.
        """
        (dimensions,) = checked_sizes(config, "dimensions")
        if dimensions > 2**14:
            raise FileFormatError(f"Student density: found {dimensions} dimensions, expected at most {2**14}")
        return cls(torch.zeros(dimensions, dimensions), 1.0)


def _sample_weights(x: Tensor, precision: Tensor | None, degrees_of_freedom: float) -> Tensor:
    """How much each sample of (T,D) counts under a precision (D,D), (T,); all 1 before there is one."""
    if precision is None:
        return torch.ones(len(x), dtype=x.dtype, device=x.device)
    return (degrees_of_freedom + x.shape[1]) / (degrees_of_freedom + ((x @ precision) * x).sum(1))


class StudentGroups(nn.Module):
    """The energy of Student's distributions of G groups of shapes, its products prepared: for exported solvers."""

    precisions: Tensor
    freedoms: Tensor
    sizes: Tensor

    def __init__(self, groups: Sequence[Sequence[int]], densities: Sequence[StudentDensity], strength: float) -> None:
        super().__init__()
        self.strength = strength
        like = densities[0].factor.double()
        sizes = like.new_tensor([float(len(group)) for group in groups])
        shapes = int(sizes.sum())
        precisions = like.new_zeros(len(groups), shapes, shapes)
        for precision, group, density in zip(precisions, groups, densities, strict=True):
            rows, factor = torch.tensor(group, device=like.device), density.factor.double()
            precision[rows[:, None], rows] = factor @ factor.T
        freedoms = torch.stack([density.degrees_of_freedom for density in densities]).double()
        tables = {"precisions": precisions, "freedoms": freedoms, "sizes": sizes}
        for name, value in tables.items():
            self.register_buffer(name, value)

    def energy(self, weights: Tensor) -> Quadratic:
        """As of ``ShapePrior.energy``, at weights (1,N) float64."""
        distance = (self.precisions @ weights[0]) @ weights[0]
        factors = self.strength * (self.freedoms + self.sizes) / (self.freedoms + distance)
        precision = (factors[:, None, None] * self.precisions).sum(0)
        return Quadratic(precision[None], torch.zeros_like(weights))
