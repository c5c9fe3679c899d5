"""Detail from the weights of the actor's rig, looked at beside the shape of each region."""

import torch
from torch import Tensor

from torchface.enhancement.matching.region_projection import Matched, RegionProjection

_LENGTHS = (1.0, 2.0, 4.0, 8.0)  # of the median distance between the database's frames
_NOISES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)  # of the kernel's variance
_TURNS, _TRIED = 4, 400  # parts of the sequences; frames at most
_QUANTILE, _MARGIN = 0.95, 2.0


class WeightMap:
    r"""A Gaussian process, by region, from features and the rig's weights to detail.

    .. math:: c &= (1 - \gamma)\, c_0 + \gamma\, (\bar c + k(q)^\top \alpha + \epsilon\, w^\top \alpha), \qquad
        \gamma = \min(1, v / \sigma^2(q))^2 \\
        \alpha &= (K + \epsilon I)^{-1} (C - \bar c), \qquad k(p, q) = \exp(-\lVert p - q \rVert^2 / 2 \ell^2)

    q is a frame's features and its weights, each over their spread in the database; without weights, :math:`c_0` and
    the blend w are found. :math:`\epsilon \alpha` is what the process takes for noise in the database, whose frames so
    come back. The process' variance :math:`\sigma^2` is small near the database's pairs of shape and weights. Beyond
    its limit v, for unseen expressions or another rig's weights, :math:`c_0` takes over.

    Args:
        terms: :math:`\ell, \epsilon, v` of each region, (R,3), see :func:`weight_terms`.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, equations 2.25 and 2.26.
    """

    def __init__(self, projection: RegionProjection, weights: Tensor, coefficients: Tensor, terms: Tensor) -> None:
        self._projection, self._terms = projection, terms.double()
        self._spread = _spread(weights)
        self._mean = coefficients.double().mean(0)
        self._points = [torch.cat([own, weights.double() / self._spread], 1) for own in _scaled(projection)]
        self._factors, self._maps = [], []
        for points, (length, noise, _) in zip(self._points, self._terms.tolist(), strict=True):
            factor = _factor(points, length, noise)
            self._factors.append(factor)
            self._maps.append(torch.cholesky_solve(coefficients.double() - self._mean, factor))

    def blended(self, features: Tensor, weights: Tensor, matched: Matched, found: Tensor) -> Tensor:
        r"""Coefficients (T,R,r) that weights (T,N) improve, of features (T,P,9); differentiable in both.

        Args:
            found: :math:`c_0`, (T,R,r).
        """
        own = weights.double() / self._spread
        none = torch.zeros_like(matched.weights)
        regions = zip(
            self._projection.residuals(features, none), self._projection.spread, self._points, self._factors,
            self._maps, self._terms.tolist(), matched.weights.unbind(1), strict=True,
        )  # fmt: skip
        means, shares = [], []
        for rows, spread, points, factor, learned, (length, noise, limit), blend in regions:
            near = _kernel(torch.cat([rows / spread, own], 1), points, length)
            left = noise * (blend.double() @ learned)  # of the database, as noise
            means.append(near @ learned + left + self._mean)
            shares.append((limit / _variance(near, factor, noise)).clamp(max=1).square())
        share = torch.stack(shares, 1)[..., None].to(found)
        return found + share * (torch.stack(means, 1).to(found) - found)


def weight_terms(projection: RegionProjection, weights: Tensor, coefficients: Tensor, sequences: Tensor) -> Tensor:
    r"""Length, noise and limit of each region's process, (R,3) float64.

    A quarter of the sequences is left out in turn: length and noise leave the least error in these frames, and the
    limit is twice the variance below which 95 % of them lie.

    Args:
        sequences: the number of each frame's sequence, (K,) int64.
    """
    chosen = torch.linspace(0, len(weights) - 1, min(_TRIED, len(weights))).long()
    numbers = sequences.unique()
    turns = min(_TURNS, len(numbers))
    turn = (torch.arange(len(numbers)) * turns // len(numbers))[torch.searchsorted(numbers, sequences[chosen])]
    if turns < 2:
        turn, turns = torch.arange(len(chosen)) % 2, 2
    rows, wanted = (weights.double() / _spread(weights))[chosen], coefficients.double()[chosen]
    terms = []
    for own in _scaled(projection):
        points = torch.cat([own[chosen], rows], 1)
        median = float(torch.cdist(points, points).median().clamp(min=1e-6))
        tried = [_held_out(points, wanted, turn, turns, median * length) for length in _LENGTHS]
        errors = torch.tensor([[error for error, _ in row] for row in tried])
        best, noise = divmod(int(errors.argmin()), len(_NOISES))
        limit = _MARGIN * float(tried[best][noise][1].quantile(_QUANTILE))
        terms.append([median * _LENGTHS[best], _NOISES[noise], limit])
    return torch.tensor(terms, dtype=torch.float64)


def _held_out(points: Tensor, wanted: Tensor, turn: Tensor, turns: int, length: float) -> list[tuple[float, Tensor]]:
    """For each noise the squared error in the frames left out, and their variances."""
    errors = [0.0] * len(_NOISES)
    variances: list[list[Tensor]] = [[] for _ in _NOISES]
    for left_out in range(turns):
        known, own = turn != left_out, turn == left_out
        near = _kernel(points[own], points[known], length)
        values, vectors = torch.linalg.eigh(_kernel(points[known], points[known], length))
        mean = wanted[known].mean(0)
        inside, target = near @ vectors, vectors.T @ (wanted[known] - mean)
        for number, noise in enumerate(_NOISES):
            left = values.clamp(min=0) + noise
            errors[number] += float((inside / left @ target + mean - wanted[own]).square().sum())
            variances[number].append(1 + noise - (inside.square() / left).sum(1))
    return [(error, torch.cat(parts)) for error, parts in zip(errors, variances, strict=True)]


def _scaled(projection: RegionProjection) -> list[Tensor]:
    return [known / spread for known, spread in zip(projection.known, projection.spread, strict=True)]


def _spread(weights: Tensor) -> Tensor:
    rows = weights.double()
    return (rows - rows.mean(0)).square().sum(1).mean().sqrt().clamp(min=1e-6)


def _kernel(rows: Tensor, points: Tensor, length: float) -> Tensor:
    squared = rows.square().sum(1)[:, None] + points.square().sum(1) - 2 * rows @ points.T
    return torch.exp(-0.5 * squared.clamp(min=0) / length**2)


def _factor(points: Tensor, length: float, noise: float) -> Tensor:
    return torch.linalg.cholesky(_kernel(points, points, length) + noise * torch.eye(len(points)).to(points))


def _variance(near: Tensor, factor: Tensor, noise: float) -> Tensor:
    """Of the process at frames whose kernels with the database are (T,K), (T,), noise counted."""
    return (1 + noise - torch.linalg.solve_triangular(factor, near.T, upper=False).square().sum(0)).clamp(min=noise)
