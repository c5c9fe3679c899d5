"""Curves of weights that bend little: a quadratic over all frames of a take, Huber's function of second differences."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from scipy.fft import dct, idct
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.number_checks import check_rate

HUBER_THRESHOLD = 0.005
"""At 60 frames a second, in weights: larger second differences count linearly, so that blinks keep their height."""
REFERENCE_FPS = 60.0
"""For which smoothness and threshold are stated."""

_RHO, _RELAXATION = 0.12, 1.8
_MAX_ITERATIONS, _TOLERANCE = 400, 2e-4
# From a start near the end, of equations without noise, each weight has a step of its own, so that a third of the
# iterations comes as near.
_RHO_NEAR, _TOLERANCE_NEAR = 0.1, 1e-3


def smooth_in_box(H: Tensor, slopes: Tensor, fps: float, smoothness: float) -> Tensor:
    r"""Weights (T,N) in [0,1] of frames of one H (N,N) and slopes f (T,N), calm as :class:`WholeTakeSolver`'s.

    Args:
        smoothness: :math:`\lambda` at 60 frames a second, in the unit of the energies.

    Example:
        >>> steps = torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64)[:, None]
        >>> smooth_in_box(2 * torch.eye(1, dtype=torch.float64), -2 * steps, 60.0, 0.0)[:, 0].round(decimals=2).tolist()
        [0.0, 0.0, 1.0, 1.0]
    """
    check_rate(fps, "fps", ValueRangeError)
    own, threshold = smoothness * (fps / REFERENCE_FPS) ** 4, HUBER_THRESHOLD * (REFERENCE_FPS / fps) ** 2
    start = (-torch.linalg.solve(H, slopes.T).T).clamp(0, 1)
    own_steps = _RHO_NEAR * (H.diagonal() * H.diagonal().mean()).sqrt()
    problem = SmoothProblem.of(H, len(slopes), own, threshold, own_steps, _TOLERANCE_NEAR)
    return problem.least(lambda _: slopes, start, torch.zeros_like(slopes))[0]


@dataclass(frozen=True, eq=False)
class SmoothProblem:
    r"""The smooth part of the problem in the basis that makes it diagonal: eigenvectors of H and the steps, cosines."""

    vectors: Tensor
    divisor: Tensor
    rho: Tensor
    smoothness: float
    huber_threshold: float
    tolerance: float

    @staticmethod
    def of(
        H: Tensor,
        frames: int,
        smoothness: float,
        huber_threshold: float,
        rho: Tensor | None = None,
        tolerance: float = _TOLERANCE,
    ) -> "SmoothProblem":
        rho = _RHO * H.diagonal().mean().expand(len(H)) if rho is None else rho
        values, vectors = torch.linalg.eigh(H + rho.diag())
        waves = torch.arange(frames, dtype=H.dtype, device=H.device) * (math.pi / frames)
        bending = (2 - 2 * torch.cos(waves)).square()
        divisor = values + (2 * smoothness) * bending[:, None]
        return SmoothProblem(vectors, divisor, rho, smoothness, huber_threshold, tolerance)

    def least(
        self, slope: Callable[[Tensor], Tensor], z: Tensor, dual: Tensor, pull: "Pull | None" = None
    ) -> tuple[Tensor, Tensor]:
        """Weights (T,N) and the scaled dual there, from a start; ``slope`` gives f at weights."""
        for _ in range(_MAX_ITERATIONS):
            f = slope(z)
            if self.huber_threshold != math.inf:
                difference = curvature(z)
                excess = difference.sign() * (difference.abs() - self.huber_threshold).clamp(min=0)
                f = f - 2 * self.smoothness * curvature(excess)
            spectrum = _transform((self.rho * (z - dual) - f) @ self.vectors) / self.divisor
            x = _inverse_transform(spectrum) @ self.vectors.T
            v = _RELAXATION * x + (1 - _RELAXATION) * z + dual
            before, z = z, (v if pull is None else pull.followed(v, self.rho)).clamp(0, 1)
            dual = v - z
            if float((z - before).abs().max()) < self.tolerance:
                break
        return z, dual


@dataclass(frozen=True, eq=False)
class Pull:
    """What predictions ask of each frame: weights (T,N) near goals (T,N), over all markers."""

    goal: Tensor
    weight: Tensor

    def followed(self, weights: Tensor, rho: Tensor) -> Tensor:
        """The weights (T,N) that are best for the pull and, by ``rho`` (N,), near given ones."""
        return (rho * weights + 2 * self.weight * self.goal) / (rho + 2 * self.weight)

    def at(self, rows: Tensor, frames: int) -> "Pull":
        """The same where these frames are ``rows`` (T,) of more."""
        empty = self.goal.new_zeros(frames, self.goal.shape[1])
        return Pull(empty.index_copy(0, rows, self.goal), empty.index_copy(0, rows, self.weight))


def huber(weights: Tensor, threshold: float) -> Tensor:
    """The sum of Huber's function of all second differences."""
    size = curvature(weights).abs()
    if threshold == math.inf:
        return size.square().sum()
    return torch.where(size <= threshold, size.square(), 2 * threshold * size - threshold * threshold).sum()


def curvature(weights: Tensor) -> Tensor:
    """Second differences over time with their sign turned, (T,N); at both ends the curve counts as mirrored."""
    padded = torch.cat([weights[:1], weights, weights[-1:]])
    return 2 * weights - padded[2:] - padded[:-2]


def _transform(x: Tensor) -> Tensor:
    return torch.from_numpy(dct(x.cpu().numpy(), type=2, norm="ortho", axis=0)).to(x.device)


def _inverse_transform(x: Tensor) -> Tensor:
    return torch.from_numpy(idct(x.cpu().numpy(), type=2, norm="ortho", axis=0)).to(x.device)
