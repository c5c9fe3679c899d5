"""The morphable model: a mean, the ways in which samples differ from it, and how much they do."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.files.documents import Value
from torchface.geometry.sample_batches import Samples, SamplesInMemory
from torchface.modeling.morphable.principal_components import principal_components
from torchface.number_checks import as_real, as_tensor, checked_count, checked_indices, checked_number
from torchface.optim.full_precision import full_precision
from torchface.progress import Progress

_MAX_BYTES = 2**31


class MorphableModel(nn.Module):
    r"""A linear Gaussian model of any quantity a vertex: positions, colours, others.

    .. math:: x = \bar x + \sum_k a_k \sigma_k u_k, \qquad a \sim N(0, I)

    Coefficients :math:`a` are in standard deviations. What is learned lies in float32 buffers.

    Args:
        mean: :math:`\bar x`, (V,C).
        components: orthonormal :math:`u_k`, (K,V,C).
        standard_deviations: :math:`\sigma_k`, (K,), positive, falling; in the unit of the samples, over all vertices.
        total_variance: of the samples it was learned from, over all vertices and channels; that of the components
            if absent.
        samples: how many it was learned from; 0 where that is not known.

    Raises:
        ShapeError: the shapes do not fit.

    Source: thesis 3.2.4, equations 8 and 9 (whose exponent means the squares of coefficients over variances).

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> line = torch.randn(20, 1, 1, generator=generator) * torch.ones(5, 3)  # samples that differ in one way
        >>> model = MorphableModel.fit(line.float())
        >>> model.count, round(model.explained[0].item(), 3)
        (1, 1.0)
    """

    mean: Tensor
    components: Tensor
    standard_deviations: Tensor
    total_variance: Tensor

    def __init__(
        self,
        mean: Tensor,
        components: Tensor,
        standard_deviations: Tensor,
        total_variance: Tensor | float | None = None,
        samples: int = 0,
    ) -> None:
        super().__init__()
        if mean.ndim != 2 or components.ndim != 3 or components.shape[1:] != mean.shape:
            raise ShapeError(
                f"morphable model: found mean {tuple(mean.shape)} and components {tuple(components.shape)}, "
                "expected (V,C) and (K,V,C)"
            )
        if standard_deviations.shape != components.shape[:1]:
            raise ShapeError(
                f"standard_deviations: found {tuple(standard_deviations.shape)}, expected ({len(components)},)"
            )
        if total_variance is None:
            total_variance = standard_deviations.double().square().sum()
        self.register_buffer("mean", mean.detach().float().contiguous())
        self.register_buffer("components", components.detach().float().contiguous())
        self.register_buffer("standard_deviations", standard_deviations.detach().float().contiguous())
        self.register_buffer("total_variance", torch.as_tensor(total_variance).detach().to(mean.device).float())
        self.samples = samples

    @classmethod
    def fit(
        cls,
        samples: Tensor | Samples,
        components: int | None = None,
        checkpoint: str | Path | None = None,
        progress: Progress | None = None,
    ) -> "MorphableModel":
        """Learns from samples in correspondence, in memory or read in blocks.

        Args:
            samples: (M,V,C), aligned: a tensor, or what reads some at a time, such as a
                :class:`torchface.io.meshes.mesh_sequence.MeshSequence`.
            components: how many; if absent as many as the samples differ in, at most M-1, and at most 200 of more
                than 1,500 samples that are read in blocks.
            checkpoint: a folder in which a killed run continues, see
                :func:`~torchface.modeling.morphable.principal_components.principal_components`.
            progress: called with each step and how far it is.

        Raises:
            ShapeError: no (M,V,C), or fewer than two samples.
            ValueRangeError: NaN or infinity, samples that are all the same, or more components than they hold.
            FileFormatError: the checkpoint cannot be written.

        Example:
            >>> from torchface.io import MeshSequence, MeshSequenceWriter
            >>> heads = torch.randn(6, 40, 3, generator=torch.Generator().manual_seed(0)).float()
            >>> with MeshSequenceWriter("heads.safetensors", 6, 40, torch.tensor([[0, 1, 2]])) as writer:
            ...     writer.append(heads)
            >>> streamed = MorphableModel.fit(MeshSequence("heads.safetensors"), 3)
            >>> at_once = MorphableModel.fit(heads, 3)
            >>> torch.allclose(streamed.standard_deviations, at_once.standard_deviations, rtol=1e-4)
            True
        """
        if not hasattr(samples, "read"):
            samples = as_tensor("samples", samples, "(M,V,C)", torch.get_default_dtype())
        count, most = samples.shape[0], components
        if len(samples.shape) != 3 or (isinstance(samples, Tensor) and not samples.is_floating_point()):
            raise ShapeError(f"samples: found {tuple(samples.shape)}, expected floats (M,V,C)")
        if components is not None:
            checked_count(f"components of {count} samples", components, 1, max(count - 1, 1))
        device = torch.device("cpu")
        if isinstance(samples, Tensor):
            device, samples, most = samples.device, SamplesInMemory(samples.detach().cpu()), most or count
        learned = principal_components(samples, most, checkpoint, progress)
        if components is not None and components > len(learned.components):
            raise ValueRangeError(
                f"components: found {components}, expected at most {len(learned.components)}: that is in how many "
                f"ways the {count} samples differ (some are duplicates or mixtures of others)"
            )
        model = cls(
            learned.mean.reshape(samples.shape[1:]),
            learned.components.reshape(-1, *samples.shape[1:]),
            learned.standard_deviations,
            learned.total_variance,
            count,
        )
        return model.to(device)

    def extra_repr(self) -> str:
        return f"{self.count} components of {len(self.mean)} vertices"

    @property
    def count(self) -> int:
        """How many components, K."""
        return len(self.standard_deviations)

    @property
    def modes(self) -> Tensor:
        """What one standard deviation of each component adds to the mean, (K,V,C)."""
        return self.components * self.standard_deviations[:, None, None]

    @property
    def explained(self) -> Tensor:
        """The share of the total variance that the first components hold, (K,), rising."""
        return self.standard_deviations.double().square().cumsum(0) / self.total_variance.double()

    @full_precision
    def forward(self, coefficients: Tensor) -> Tensor:
        """Coefficients (B,K) to samples (B,V,C)."""
        coefficients = self._checked(coefficients)
        scaled = coefficients * self.standard_deviations.to(coefficients)
        offset = scaled @ self.components.flatten(1).to(coefficients)
        return self.mean.to(coefficients) + offset.reshape(-1, *self.mean.shape)

    @full_precision
    def project(self, samples: Tensor, vertices: Tensor | None = None, noise: float | Tensor | None = None) -> Tensor:
        r"""The coefficients that explain samples.

        .. math:: a = \arg\min_a \; \sum_i \lVert x_i - \bar x_i - (M a)_i \rVert^2 / \nu_i^2 \; + \lVert a \rVert^2

        with modes :math:`M`: the posterior mean under noise of deviation :math:`\nu`. Without noise the second term
        is left out: the orthogonal projection, or the shortest least-squares solution where the vertices do not
        determine all coefficients.

        Args:
            samples: (B,V,C), or (B,N,C) of the ``vertices``; a vertex with a NaN counts as missing.
            vertices: ids (N,) int64, or a mask (V,); all of them if absent.
            noise: standard deviation in the unit of the samples, a number or one a vertex (N,).

        Returns:
            Coefficients (B,K), in the model's precision.

        Raises:
            ShapeError: the shapes differ from the above.
            ValueRangeError: infinity, noise that is not positive, or vertex ids outside the model.

        Source: thesis 3.2.4; Albrecht, Luethi, Vetter 2008 (posterior shape models).
        """
        samples = as_tensor("samples", samples, "(B,V,C)").to(self.mean)
        mean, components = self.mean, self.components
        if vertices is not None:
            vertices = self._chosen(vertices)
            mean, components = mean[vertices], components[:, vertices]
        if samples.ndim != 3 or samples.shape[1:] != mean.shape:
            raise ShapeError(f"samples: found {tuple(samples.shape)}, expected (B,{mean.shape[0]},{mean.shape[1]})")
        precision = _precision(noise, len(mean)).to(mean.device)
        residual = (samples - mean).double()
        seen = ~residual.isnan().any(-1)
        infinite = residual.isinf().flatten(1).any(1).nonzero()[:, 0].tolist()
        if infinite:
            raise ValueRangeError(
                f"samples: found infinity in rows {infinite[:5]}, expected numbers, or NaN for missing"
            )
        deviations = self.standard_deviations.double()
        if vertices is None and noise is None and bool(seen.all()):
            return (residual.flatten(1).to(mean) @ components.flatten(1).T) / self.standard_deviations
        residual = torch.where(seen[..., None], residual, 0.0) * precision[:, None]
        modes = components.double() * (deviations[:, None, None] * precision[:, None])
        # Samples that miss the same vertices share one system.
        groups, member = seen.unique(dim=0, return_inverse=True)
        result = residual.new_empty((len(samples), self.count))
        for number, group in enumerate(groups):
            rows = (member == number).nonzero()[:, 0]
            basis = modes[:, group].flatten(1)
            observed = residual[rows][:, group].flatten(1)
            result[rows] = _posterior(basis, observed) if noise is not None else _least_squares(basis, observed)
        return result.to(mean)

    def log_prob(self, coefficients: Tensor) -> Tensor:
        r""":math:`-\frac12 \lVert a \rVert^2` of coefficients (B,K), (B,); the constant
        :math:`-\frac K2 \log 2\pi` is left out, so that the mean has 0."""
        coefficients = self._checked(coefficients)
        return -0.5 * coefficients.square().sum(-1)

    def sample(self, count: int, generator: torch.Generator | None = None) -> Tensor:
        """Coefficients (count,K) drawn from the model; ``model(model.sample(3))`` are three samples."""
        return torch.randn(checked_count("count", count), self.count, generator=generator).to(self.mean)

    def interpolate(self, first: Tensor, second: Tensor, steps: int) -> Tensor:
        """Coefficients (steps,K) on the straight way from one (K,) to another, both included."""
        first, second = self._checked([first, second])
        steps = checked_count("steps", steps, 2)
        return torch.lerp(first, second, torch.linspace(0, 1, steps, device=first.device, dtype=first.dtype)[:, None])

    def truncate(self, count: int | None = None, variance: float | None = None) -> "MorphableModel":
        """The model of the first components.

        Args:
            count: how many to keep.
            variance: keep as few as hold this share of the total variance, in (0,1].

        Raises:
            ValueRangeError: neither or both are given, or the model has not that many or that much.
        """
        if (count is None) == (variance is None):
            raise ValueRangeError("truncate: expected either a count or a share of the variance")
        if variance is not None:
            # What rounding to float32 leaves of a whole is still the whole.
            checked_number("variance", variance, 0.0, min(1.0, float(self.explained[-1]) + 1e-5), above=True)
            count = min(int((self.explained < variance - 1e-9).sum()) + 1, self.count)
        count = checked_count("count", count, 1, self.count)
        return MorphableModel(
            self.mean, self.components[:count], self.standard_deviations[:count], self.total_variance, self.samples
        )

    def part(self, vertices: Tensor) -> "MorphableModel":
        """The same distribution seen at some vertices only, ids (N,) or a mask (V,); its components are orthonormal
        there."""
        vertices = self._chosen(vertices)
        if len(vertices) == 0:
            raise ValueRangeError("vertices: found none, expected at least one")
        modes = self.modes[:, vertices].double().flatten(1)
        _, deviations, components = torch.linalg.svd(modes, full_matrices=False)
        kept = deviations > 1e-6 * deviations[0].clamp(min=1e-12)
        mean = self.mean[vertices]
        return MorphableModel(mean, components[kept].unflatten(1, mean.shape), deviations[kept], samples=self.samples)

    @property
    def config(self) -> dict[str, Any]:
        """Sizes from which :meth:`from_config` makes a model for the state to be loaded into."""
        vertices, channels = self.mean.shape
        return {"vertices": vertices, "channels": channels, "components": self.count, "samples": self.samples}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "MorphableModel":
        """A model of zeros with the sizes of a ``config``.

        Raises:
            FileFormatError: a size is missing, no whole number, or too large.
        """
        values = Value("config", "", config)
        sizes = (values[name].whole(1, _MAX_BYTES - 1) for name in ("vertices", "channels", "components"))
        vertices, channels, components = sizes
        if 4 * vertices * channels * (components + 1) > _MAX_BYTES:
            raise FileFormatError(f"morphable model: found sizes of more than {_MAX_BYTES} bytes, expected fewer")
        return cls(
            torch.zeros(vertices, channels),
            torch.zeros(components, vertices, channels),
            torch.zeros(components),
            0.0,
            values["samples"].whole(0, _MAX_BYTES - 1),
        )

    def _chosen(self, vertices: object) -> Tensor:
        """Ids (N,) of vertices, given as such or as a mask (V,)."""
        made = as_tensor("vertices", vertices, "(N,) of ids, or a mask (V,)")
        if made.shape != (self.mean.shape[:1] if made.dtype == torch.bool else (made.numel(),)):
            raise ShapeError(f"vertices: found {tuple(made.shape)}, expected ids (N,) or a mask ({len(self.mean)},)")
        if made.dtype == torch.bool:
            return made.nonzero()[:, 0]
        return checked_indices("vertices", vertices, len(self.mean), ValueRangeError)

    def _checked(self, coefficients: Tensor | list[Tensor]) -> Tensor:
        coefficients = as_real(coefficients, "coefficients")
        if coefficients.ndim != 2 or coefficients.shape[1] != self.count:
            raise ShapeError(f"coefficients: found {tuple(coefficients.shape)}, expected (B,{self.count})")
        return coefficients


def _precision(noise: float | Tensor | None, count: int) -> Tensor:
    """One over the deviation of each vertex, (N,) float64."""
    deviation = torch.as_tensor(1.0 if noise is None else noise, dtype=torch.float64)
    if deviation.ndim > 1 or (deviation.ndim == 1 and len(deviation) != count):
        raise ShapeError(f"noise: found {tuple(deviation.shape)}, expected a number or ({count},)")
    if not bool((deviation > 0).all()) or not math.isfinite(float(deviation.min())):
        raise ValueRangeError(f"noise: found {float(deviation.min()):g}, expected a positive deviation")
    return (1 / deviation).expand(count)


def _posterior(modes: Tensor, residual: Tensor) -> Tensor:
    matrix = modes @ modes.T
    matrix.diagonal().add_(1.0)
    factor = torch.linalg.cholesky(matrix)
    return torch.cholesky_solve(modes @ residual.T, factor).T


def _least_squares(modes: Tensor, residual: Tensor) -> Tensor:
    """The shortest solution; directions that the vertices leave open stay at the mean."""
    values, vectors = torch.linalg.eigh(modes @ modes.T)
    inverse = torch.where(values > 1e-10 * values[-1].clamp(min=1e-300), 1 / values, 0.0)
    return (residual @ modes.T) @ (vectors * inverse) @ vectors.T
