"""The Parzen window: a kernel density estimate of weights."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchface.capture.priors.gaussian_process import squared_distances
from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.files.documents import Value
from torchface.optim.mean_shift import mean_shift

_QUANTILE = 0.3
_MAX_NUMBERS = 2**28
_MAX_SAMPLES = 1000


class ParzenDensity(nn.Module):
    r"""A density of equal isotropic Gaussians around centres.

    .. math:: p(x) = \frac{1}{K} \sum_{k=1}^{K} \exp\Big(-\frac{\lVert x - c_k \rVert^2}{2\sigma^2}\Big)

    The Gaussians are not normalised: with the normaliser, a prior's strength would depend on the dimension.

    Args:
        centers: :math:`c_k`, (K,D).
        bandwidth: :math:`\sigma`, a positive number, in the unit of the centres.

    Source: thesis 4.2.7, equation 42, without its normaliser; 4.2.8.

    Example:
        >>> two = ParzenDensity(torch.tensor([[0.0], [1.0]], dtype=torch.float64), bandwidth=0.1)
        >>> at, between = two.log_density(torch.tensor([[1.0], [0.5]], dtype=torch.float64)).tolist()
        >>> at > between
        True
    """

    centers: Tensor
    bandwidth: Tensor

    def __init__(self, centers: Tensor, bandwidth: float | Tensor) -> None:
        super().__init__()
        if centers.ndim != 2 or not len(centers):
            raise ShapeError(f"Parzen window: found centers {tuple(centers.shape)}, expected (K,D) with at least one")
        self.register_buffer("centers", centers.detach().float())
        self.register_buffer("bandwidth", torch.as_tensor(bandwidth).detach().float().reshape(()))

    @classmethod
    def fit(cls, samples: Tensor, bandwidth: float | None = None, seed: int = 0) -> "ParzenDensity":
        """Bins samples (T,D) by mean shift, so that frequent and rare weights count alike.

        Args:
            samples: weights, (T,D).
            bandwidth: of the mean shift and of the Gaussians; :func:`automatic_bandwidth` if absent.
            seed: of the samples drawn for the automatic bandwidth.

        Raises:
            ShapeError: fewer than two samples.
            ValueRangeError: NaN, or samples that are all the same.
        """
        checked_samples(samples)
        width = automatic_bandwidth(samples, seed=seed) if bandwidth is None else bandwidth
        if not 0 < width < math.inf:
            raise ValueRangeError(f"bandwidth: found {width}, expected a positive number; are all samples the same?")
        return cls(mean_shift(samples.double(), width).centres, width)

    def log_density(self, samples: Tensor) -> Tensor:
        """:math:`\\log p` of samples (B,D), (B,), at most 0."""
        return torch.logsumexp(self._log_kernels(samples), dim=1) - math.log(len(self.centers))

    def bound(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        r"""A quadratic that touches :math:`-\log p` at samples (B,D) and lies above it everywhere else.

        With the responsibilities :math:`r_k` of the Gaussians there:
        :math:`\sum_k r_k \lVert x - c_k \rVert^2 / 2\sigma^2` and a constant.

        Returns:
            H (B,D,D) and f (B,D) of :math:`\tfrac12 x^\top H x + f^\top x`.
        """
        responsibilities = torch.softmax(self._log_kernels(samples), dim=1)
        precision = 1 / self.bandwidth.to(samples).square()
        H = (precision * torch.eye(samples.shape[1], dtype=samples.dtype, device=samples.device)).expand(
            len(samples), -1, -1
        )
        return H, -precision * (responsibilities @ self.centers.to(samples))

    def mapped(self, matrix: Tensor, floor: Tensor) -> "ParzenDensity":
        """The density with its centres at Mc, M (E,D); its Gaussians are isotropic, so the floor has no effect."""
        return ParzenDensity(self.centers @ matrix.to(self.centers).T, self.bandwidth)

    def _log_kernels(self, samples: Tensor) -> Tensor:
        return -0.5 * squared_distances(samples, self.centers.to(samples)) / self.bandwidth.to(samples).square()

    @property
    def config(self) -> dict[str, Any]:
        """Sizes from which :meth:`from_config` makes a density for the state to be loaded into."""
        return {"kind": "parzen", "centers": len(self.centers), "dimensions": self.centers.shape[1]}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "ParzenDensity":
        """A density of zeros with the sizes of a ``config``.

        Raises:
            FileFormatError: a size is missing or too large.
        """
        return cls(torch.zeros(*checked_sizes(config, "centers", "dimensions")), 1.0)


def automatic_bandwidth(samples: Tensor, seed: int = 0) -> float:
    """The mean distance from a sample to its k-th nearest neighbour, k a fraction of all samples.

    Args:
        samples: (T,D); of more than a thousand, a thousand are drawn.
        seed: of the draw.

    Source: thesis 4.2.8; the rule of scikit-learn's ``estimate_bandwidth``.

    Example:
        >>> dense, wide = torch.linspace(0, 1, 101)[:, None], torch.linspace(0, 10, 101)[:, None]
        >>> round(automatic_bandwidth(wide) / automatic_bandwidth(dense))
        10
    """
    checked_samples(samples)
    generator = torch.Generator().manual_seed(seed)
    some = samples.double()[torch.randperm(len(samples), generator=generator)[:_MAX_SAMPLES]]
    nearest = max(int(_QUANTILE * len(some)), 1)
    return float(torch.cdist(some, some).kthvalue(nearest, dim=1).values.mean())


def checked_sizes(config: Mapping[str, Any], *names: str) -> tuple[int, ...]:
    """Whole numbers of a config whose product fits the memory."""
    sizes = tuple(Value("density", "", config)[name].whole(1) for name in names)
    if math.prod(sizes) > _MAX_NUMBERS:
        raise FileFormatError(f"density: found sizes {sizes}, expected at most {_MAX_NUMBERS} numbers")
    return sizes


def checked_samples(samples: Tensor) -> Tensor:
    """Samples (T,D), at least two and finite; otherwise ``ShapeError`` or ``ValueRangeError``."""
    if samples.ndim != 2 or len(samples) < 2:
        raise ShapeError(f"samples: found {tuple(samples.shape)}, expected (T,D) with at least two")
    if not torch.isfinite(samples).all():
        raise ValueRangeError("samples: found NaN or infinity, expected weights")
    return samples
