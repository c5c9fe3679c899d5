"""Batch smoothing: blendshape weights of all frames of a take in one solve, with a smoothness term over time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from scipy.fft import dct, idct
from torch import Tensor

from torchface.capture.markers.marker_solver import MarkerSolver, penalty_value
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.number_checks import LARGEST_WEIGHT, check_rate, checked_number
from torchface.take import Take, Track

SMOOTHNESS = 10.0
"""At 60 frames a second, mm² a marker for a squared second difference of 1: noise of 0.3 mm hardly shows."""
HUBER_THRESHOLD = 0.005
"""At 60 frames a second, in weights: larger second differences count linearly, so that blinks keep their height."""
# Neighbouring frames regularise, so a tenth of a single frame's L1 penalty is enough.
SPARSITY_RATIO = 0.1

_RHO, _RELAXATION = 0.12, 1.8
_MAX_ITERATIONS, _TOLERANCE = 400, 2e-4
_REFERENCE_FPS = 60.0


@dataclass(frozen=True, eq=False)
class WholeTakeSolver:
    r"""Solves markers for the weights of all frames of a take together.

    .. math::
        \min_{0 \le w_t \le 1} \sum_t \Big( \frac{1}{M} \sum_{m \in S_t} \lVert b_m + B_m w_t - y_{tm} \rVert^2
        + \beta \sum_i w_{ti} + \varepsilon \lVert w_t \rVert^2
        + \lambda \sum_i h_\tau(w_{t-1,i} - 2 w_{ti} + w_{t+1,i}) \Big)

    with Huber's :math:`h_\tau(d) = d^2` for :math:`|d| \le \tau` and :math:`2\tau|d| - \tau^2` beyond it: slow motion
    is smoothed, a blink or a syllable passes. The first term counts all M markers, seen or not, so a frame that
    shows few of them depends more on its neighbours, and one that shows none is interpolated.

    Args:
        markers: rig, attachment, alignment and ridge; its sparsity is for single frames, see ``sparsity``.
        smoothness: :math:`\lambda` at 60 frames a second, mm² a marker.
        huber_threshold: :math:`\tau` at 60 frames a second; infinite for a quadratic term.
        sparsity: :math:`\beta`, mm² a marker for a weight of 1; a tenth of the marker solver's if absent.

    Raises:
        ValueRangeError: a setting is negative or NaN.

    Source: thesis 4.1.5 asks for curves that are smooth; the term is a robust form of Whittaker's.
    """

    markers: MarkerSolver
    smoothness: float = SMOOTHNESS
    huber_threshold: float = HUBER_THRESHOLD
    sparsity: float | None = None

    def __post_init__(self) -> None:
        sparsity = SPARSITY_RATIO * penalty_value(self.markers.sparsity) if self.sparsity is None else self.sparsity
        object.__setattr__(self, "sparsity", float(sparsity))
        for name in ("smoothness", "huber_threshold", "sparsity"):
            value = getattr(self, name)
            if not (name == "huber_threshold" and value == math.inf):
                checked_number(name, value, 0.0, LARGEST_WEIGHT)

    def solve_take(self, take: Take) -> Take:
        """The take with weights solved from its markers, matched by label.

        Raises:
            NameMismatchError: the take has no markers, labels that the attachment does not know, or none that it knows.
            ValueRangeError: no frame shows any marker, or a coordinate is infinite.
        """
        if take.markers is None:
            raise NameMismatchError("take: has no markers, expected a track of them")
        weights = self(self.markers.arrange(take.markers), take.fps)
        return replace(take, weights=Track(self.markers.names, weights[..., None]))

    def __call__(self, markers: Tensor, fps: float = _REFERENCE_FPS) -> Tensor:
        """Weights (T,N) for the markers (T,M,3) of consecutive frames, NaN for not seen.

        Raises:
            ShapeError: ``markers`` is not (T,M,3).
            ValueRangeError: no frame shows any marker, or a coordinate is infinite.
        """
        if markers.ndim != 3 or markers.shape[1:] != self.markers.rest.shape:
            raise ShapeError(f"markers: found {tuple(markers.shape)}, expected (T,{len(self.markers.rest)},3)")
        if torch.isinf(markers).any():
            raise ValueRangeError("markers: found infinite coordinates, expected millimetres, or NaN for not seen")
        if not len(markers) or bool(torch.isnan(markers).any(-1).all()):
            raise ValueRangeError(f"markers: found none in any of {len(markers)} frames, expected some")
        return self._solve(markers.double(), *self._scaled(fps)).to(markers.dtype)

    def energy(self, markers: Tensor, weights: Tensor, fps: float = _REFERENCE_FPS) -> float:
        """What the solve minimises, over all frames."""
        smoothness, huber_threshold = self._scaled(fps)
        solver = self.markers
        seen = markers.double() if solver.alignment is None else solver.alignment.apply(markers.double())
        w = weights.double()
        points = solver.rest.double() + torch.einsum("mcn,tn->tmc", solver.basis.double(), w)
        data = (points - seen).square().sum(-1).nan_to_num(0.0).sum() / points.shape[1]
        size = curvature(w).abs()
        huber = torch.where(
            size <= huber_threshold, size.square(), 2 * huber_threshold * size - huber_threshold * huber_threshold
        )
        if huber_threshold == math.inf:
            huber = size.square()
        penalty = self.sparsity or 0.0
        return float(
            data + penalty * w.sum() + penalty_value(solver.ridge) * w.square().sum() + smoothness * huber.sum()
        )

    def _scaled(self, fps: float) -> tuple[float, float]:
        """A second difference of the same motion falls with the square of the frame rate."""
        check_rate(fps, "fps", ValueRangeError)
        return self.smoothness * (fps / _REFERENCE_FPS) ** 4, self.huber_threshold * (_REFERENCE_FPS / fps) ** 2

    def _solve(self, markers: Tensor, smoothness: float, huber_threshold: float) -> Tensor:
        r"""Splitting: a smooth problem without bounds, then a clamp.

        The smooth problem has one H and one Laplacian K in all frames. A cosine transform over time diagonalises K, the
        eigenvectors of H the rest, so a step is two transforms, products and a division. What differs from frame to
        frame is on its right side, updated by majorisation, which keeps the minimum: a marker that is not seen is
        filled in by the weights, and the part b of a second difference beyond :math:`\tau` is subtracted,
        :math:`h_\tau(d) = \min_b (d - b)^2 + 2\tau|b|`.

        Source: Boyd et al. 2011, section 5.2; Geman and Yang 1995 for b.
        """
        solver = self.markers
        seen = markers if solver.alignment is None else solver.alignment.apply(markers)
        rest, rows = solver.rest.double(), solver.basis.double().flatten(0, 1)
        count, shapes = len(rest), rows.shape[1]
        H = (2.0 / count) * (rows.T @ rows)
        H.diagonal().add_(2 * penalty_value(solver.ridge))
        values, vectors = torch.linalg.eigh(H)
        rho = _RHO * float(H.diagonal().mean())
        waves = torch.arange(len(seen), dtype=torch.float64) * (math.pi / len(seen))
        bending = (2 - 2 * torch.cos(waves)).square()
        divisor = values + (2 * smoothness) * bending[:, None] + rho
        gaps = torch.isnan(seen).any(-1)
        seen_mask = ~gaps[..., None]
        offset = torch.where(seen_mask, rest - seen.nan_to_num(0.0), 0.0).flatten(1) @ rows * (2.0 / count)
        frames = gaps.any(-1).nonzero()[:, 0]
        hidden = gaps[frames].repeat_interleave(3, dim=1)
        z = seen.new_zeros(len(seen), shapes)
        dual = torch.zeros_like(z)
        penalty = self.sparsity or 0.0
        for _ in range(_MAX_ITERATIONS):
            f = offset + penalty
            if len(frames):
                f[frames] -= (torch.where(hidden, z[frames] @ rows.T, 0.0) @ rows) * (2.0 / count)
            if huber_threshold != math.inf:
                difference = curvature(z)
                excess = difference.sign() * (difference.abs() - huber_threshold).clamp(min=0)
                f = f - 2 * smoothness * curvature(excess)
            spectrum = _transform((rho * (z - dual) - f) @ vectors) / divisor
            x = _inverse_transform(spectrum) @ vectors.T
            v = _RELAXATION * x + (1 - _RELAXATION) * z + dual
            before, z = z, v.clamp(0, 1)
            dual = v - z
            if float((z - before).abs().max()) < _TOLERANCE:
                break
        return z


def curvature(weights: Tensor) -> Tensor:
    """Second differences over time with their sign turned, (T,N); at both ends the curve counts as mirrored."""
    padded = torch.cat([weights[:1], weights, weights[-1:]])
    return 2 * weights - padded[2:] - padded[:-2]


def _transform(x: Tensor) -> Tensor:
    return torch.from_numpy(dct(x.numpy(), type=2, norm="ortho", axis=0))


def _inverse_transform(x: Tensor) -> Tensor:
    return torch.from_numpy(idct(x.numpy(), type=2, norm="ortho", axis=0))
