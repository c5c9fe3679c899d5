"""Principal components of few samples with many numbers each, by way of their Gram matrix."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError

_CHUNK = 4096
_BLOCK = 64
_NO_VARIANCE = 1e-12
"""Of the largest eigenvalue: what rounding leaves where there is nothing."""


@dataclass(frozen=True, eq=False)
class PrincipalComponents:
    """What a linear Gaussian model learns.

    Args:
        mean: (D,) float64.
        components: orthonormal rows (K,D) floats, the one that varies most first.
        standard_deviations: of the samples along them, (K,) float64.
        total_variance: of the samples, all D dimensions summed, kept or not.
        rank: how many components the samples have.
    """

    mean: Tensor
    components: Tensor
    standard_deviations: Tensor
    total_variance: float
    rank: int


def principal_components(samples: Tensor, count: int | None = None) -> PrincipalComponents:
    r"""The directions in which samples vary most.

    .. math:: G = X X^\top = V \Lambda V^\top, \quad u_k = X^\top v_k / \sqrt{\lambda_k}, \quad
        \sigma_k^2 = \lambda_k / (M - 1)

    for centred samples X (M,D) with :math:`M \ll D`. Sums are taken in float64. A component points to where
    :math:`\sum_i u_i \cos i` is positive, so that the same samples in any order give the same ones.

    Args:
        samples: (M,D) floats.
        count: how many components; as many as the samples have if absent.

    Raises:
        ShapeError: fewer than two samples, or no (M,D).
        ValueRangeError: a sample is NaN or infinite, the samples are all the same, or have fewer components than
            asked for.

    Source: thesis 3.2.4, equation 8; Turk, Pentland 1991.
    """
    if samples.ndim != 2 or not samples.is_floating_point():
        raise ShapeError(f"samples: found {samples.dtype} {tuple(samples.shape)}, expected floats (M,D)")
    check_count(len(samples), count)
    mean = samples.new_empty(samples.shape[1], dtype=torch.float64)
    gram = samples.new_zeros((len(samples), len(samples)), dtype=torch.float64)
    # In pieces: the samples in float64 all at once would be twice what is already in memory.
    for begin in range(0, samples.shape[1], _CHUNK):
        piece = samples[:, begin : begin + _CHUNK].double()
        mean[begin : begin + _CHUNK] = piece.mean(0)
        add_outer_product(gram, piece.sub_(mean[begin : begin + _CHUNK]))
    if not bool(torch.isfinite(mean).all()):
        bad = int((~torch.isfinite(samples)).any(1).sum())
        raise ValueRangeError(f"samples: {bad} of {len(samples)} hold NaN or infinity; expected none")
    spectrum = gram_spectrum(gram, rounding(samples), count)
    components = samples.new_empty((len(spectrum.values), samples.shape[1]), dtype=torch.float32)
    toward = (spectrum.vectors / spectrum.values.sqrt()).T.contiguous()
    for begin in range(0, samples.shape[1], _CHUNK):
        piece = samples[:, begin : begin + _CHUNK].double().sub_(mean[begin : begin + _CHUNK])
        components[:, begin : begin + _CHUNK] = toward @ piece
    components.mul_(signs(components)[:, None])
    return PrincipalComponents(
        mean,
        components,
        (spectrum.values / (len(samples) - 1)).sqrt(),
        spectrum.trace / (len(samples) - 1),
        spectrum.rank,
    )


def add_outer_product(gram: Tensor, piece: Tensor) -> None:
    """Adds P Pᵀ of a piece (M,D) to the lower triangle of a matrix (M,M), block by block of rows."""
    for begin in range(0, len(piece), _BLOCK):
        end = begin + _BLOCK
        gram[begin:end, :end].addmm_(piece[begin:end], piece[:end].T)


@dataclass(frozen=True, eq=False)
class GramSpectrum:
    """Largest eigenvalues (K,) of a Gram matrix with eigenvectors (M,K), its trace and its rank."""

    values: Tensor
    vectors: Tensor
    trace: float
    rank: int


def rounding(samples: Tensor) -> float:
    """An eigenvalue of the Gram matrix of samples (M,D) below which there is only their rounding."""
    largest = float(torch.maximum(samples.max(), -samples.min()))
    return (torch.finfo(samples.dtype).eps * largest) ** 2 * samples.shape[1]


def gram_spectrum(gram: Tensor, floor: float, count: int | None = None) -> GramSpectrum:
    """The largest eigenpairs of a matrix (M,M) whose lower triangle is filled, checked to be there.

    Args:
        gram: of centred samples, float64.
        floor: an eigenvalue below this counts as none.
        count: how many pairs; all above the floor if absent.

    Raises:
        ValueRangeError: the samples are all the same, or have fewer components than asked for.
    """
    values, vectors = torch.linalg.eigh(gram)
    values, vectors = values.flip(0), vectors.flip(1)
    rank = min(int((values > max(floor, _NO_VARIANCE * float(values[0]))).sum()), len(gram) - 1)
    check_rank(len(gram), rank, count)
    keep = rank if count is None else count
    return GramSpectrum(values[:keep], vectors[:, :keep], float(gram.diagonal().sum()), rank)


def signs(components: Tensor) -> Tensor:
    """+1 or -1 for each row (K,D): what makes its sum over cos(0), cos(1), ... positive."""
    weights = torch.arange(components.shape[1], device=components.device, dtype=torch.float64).cos()
    along = components @ weights.to(components)
    return torch.where(along < 0, -1.0, 1.0).to(components)


def check_count(samples: int, count: int | None) -> None:
    """Refuses what cannot be learned whatever the numbers are."""
    if samples < 2:
        raise ShapeError(f"samples: found {samples}, expected at least two to learn how they differ")
    if count is not None and not 1 <= count <= samples - 1:
        raise ValueRangeError(f"components: found {count}, expected 1 to {samples - 1} with {samples} samples")


def check_rank(samples: int, rank: int, count: int | None) -> None:
    """Refuses samples that are all the same, or differ in fewer ways than asked for."""
    if rank == 0:
        raise ValueRangeError(f"samples: found {samples} that are all the same, expected some that differ")
    if count is not None and count > rank:
        raise ValueRangeError(
            f"components: found {count}, expected at most {rank}: that is in how many ways the {samples} samples "
            "differ (some are duplicates or mixtures of others)"
        )
