"""Batch smoothing: blendshape weights of all frames of a take in one solve, with a smoothness term over time."""

import copy
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from torchface.capture.corrective_energy import CorrectiveEnergy
from torchface.capture.markers.given_markers import frames_seen, markers_of
from torchface.capture.markers.hybrid_solver import check_predictions, in_rig_order
from torchface.capture.markers.marker_solver import MarkerSolver, penalty_value
from torchface.capture.markers.smooth_problem import HUBER_THRESHOLD, REFERENCE_FPS, Pull, SmoothProblem, huber
from torchface.errors import ShapeError, TraceError, ValueRangeError
from torchface.number_checks import LARGEST_WEIGHT, as_real, check_rate, checked_number, checked_type
from torchface.optim.data_dependent import data_dependent
from torchface.take import Take, Track
from torchface.temporal import interpolated
from torchface.temporal.frame_grid import frame_grid

SMOOTHNESS = 10.0
"""At 60 frames a second, mm² a marker for a squared second difference of 1: noise of 0.3 mm hardly shows."""
# Neighbouring frames regularise, so a tenth of a single frame's L1 penalty is enough.
SPARSITY_RATIO = 0.1

# With correctives: steps at most, halvings of each, frames whose mean curvature stands for all, and the share of the
# energy that a step has to take off for another to follow.
_CORRECTED_STEPS, _HALVINGS, _HESSIAN_FRAMES, _LEAST_FALL = 20, 6, 64, 1e-4


class WholeTakeSolver(nn.Module):
    r"""Solves markers for the weights of all frames of a take together.

    .. math::
        \min_{0 \le w_t \le 1} \sum_t \Big( \frac{1}{M} \sum_{m \in S_t} \lVert b_m + B_m w_t - y_{tm} \rVert^2
        + \beta \sum_i w_{ti} + \varepsilon \lVert w_t \rVert^2
        + \lambda \sum_i h_\tau(w_{t-1,i} - 2 w_{ti} + w_{t+1,i}) \Big)

    with Huber's :math:`h_\tau(d) = d^2` for :math:`|d| \le \tau` and :math:`2\tau|d| - \tau^2` beyond it: slow motion
    is smoothed, a blink or a syllable passes. The first term counts all M markers, seen or not, so a frame that
    shows few of them depends more on its neighbours, and one that shows none is interpolated, at the take's ends
    held. What a classifier predicts pulls as in :class:`HybridSolver`, also in frames at the ends that show none.

    Args:
        markers: rig, attachment, alignment and ridge; its sparsity is for single frames, see ``sparsity``.
        smoothness: :math:`\lambda` at 60 frames a second, mm² a marker: more is calmer, and rounds quick motion off;
            change it by factors of three.
        huber_threshold: :math:`\tau` at 60 frames a second; infinite for a quadratic term.
        sparsity: :math:`\beta`, mm² a marker for a weight of 1; a tenth of the marker solver's if absent.

    Raises:
        ValueRangeError: a setting is negative or NaN.

    Source: thesis 4.1.5 asks for curves that are smooth; the term is a robust form of Whittaker's.

    Example:
        >>> from torchface import zoo
        >>> from torchface.evaluation import weight_jitter
        >>> solver = zoo.get_model("marker_solver")
        >>> still = solver.points(torch.full((30, len(solver.names)), 0.3))
        >>> noisy = still + 0.2 * torch.randn(still.shape, generator=torch.Generator().manual_seed(0))
        >>> weight_jitter(WholeTakeSolver(solver)(noisy)) < 0.5 * weight_jitter(solver(noisy))
        True
    """

    def __init__(
        self,
        markers: MarkerSolver,
        smoothness: float = SMOOTHNESS,
        huber_threshold: float = HUBER_THRESHOLD,
        sparsity: float | None = None,
    ) -> None:
        super().__init__()
        self.markers = checked_type("markers", markers, MarkerSolver)
        self.smoothness = checked_number("smoothness", smoothness, 0.0, LARGEST_WEIGHT)
        endless = huber_threshold == math.inf
        self.huber_threshold = (
            math.inf if endless else checked_number("huber_threshold", huber_threshold, 0.0, LARGEST_WEIGHT)
        )
        self._sparsity = None if sparsity is None else checked_number("sparsity", sparsity, 0.0, LARGEST_WEIGHT)

    @property
    def sparsity(self) -> float:
        """Of the L1 penalty, mm² a marker; follows the marker solver's where none was given."""
        return SPARSITY_RATIO * penalty_value(self.markers.sparsity) if self._sparsity is None else self._sparsity

    def solve_take(self, take: Take, predicted: Track | None = None, gamma: Track | None = None) -> Take:
        """The take with weights solved from its markers, matched by label, and from predictions, by name.

        Args:
            take: markers.
            predicted, gamma: (T,K,1) for any of the rig's shapes, both for the same ones; see :class:`HybridSolver`.

        Raises:
            NameMismatchError: the take has no markers, labels that the attachment does not know, or none that it knows;
                or a prediction is none of the rig's.
            ValueRangeError: no frame shows any marker, or a coordinate is infinite.
        """
        curves = [None if track is None else in_rig_order(self.markers, track) for track in (predicted, gamma)]
        weights = self(self.markers.arrange(markers_of(take)), take.fps, take.seconds, *curves)
        return replace(take, weights=Track(self.markers.names, weights[..., None]))

    @data_dependent("torchface.onnx.SolverGraph for frame by frame, which `torchface export solver` writes")
    def forward(
        self,
        markers: Tensor,
        fps: float = REFERENCE_FPS,
        seconds: Tensor | None = None,
        predicted: Tensor | None = None,
        gamma: Tensor | None = None,
    ) -> Tensor:
        """Weights (T,N) for the markers (T,M,3) of consecutive frames, NaN for not seen; without derivatives.

        Frames that come unevenly are solved on an even grid whose other frames show nothing, so that curves bend in
        seconds and not in frames.

        Args:
            markers: of the frames.
            fps: frames a second.
            seconds: when each is shown, (T,), rising, where they come unevenly.
            predicted, gamma: as :meth:`HybridSolver.forward` takes them, (T,N); both or none.

        Raises:
            ShapeError: ``markers`` is not (T,M,3), or predictions are not (T,N).
            ValueRangeError: no frame shows any marker, or a coordinate is infinite; or nearly all would be gaps.
            TraceError: ``markers`` ask for gradients.
        """
        markers = as_real(markers, "markers")
        if markers.requires_grad and torch.is_grad_enabled():
            raise TraceError(
                "WholeTakeSolver: found markers that ask for gradients, expected none, or MarkerSolver, which has them"
            )
        if markers.ndim != 3 or markers.shape[1:] != self.markers.rest.shape:
            raise ShapeError(f"markers: found {tuple(markers.shape)}, expected (T,{len(self.markers.rest)},3)")
        if torch.isinf(markers).any():
            raise ValueRangeError("markers: found infinite coordinates, expected millimetres, or NaN for not seen")
        shown = frames_seen(markers)
        begin, end = int(shown[0]), int(shown[-1]) + 1
        solve = self._solve if self.markers.activation is None else self._solve_corrected
        with torch.no_grad():
            pull = self._pull(len(markers), predicted, gamma)
            if pull is None and end - begin < len(markers):  # beyond them, smooth curves would run on
                held = self(markers[begin:end], fps, None if seconds is None else seconds[begin:end])
                return interpolated(held, torch.arange(begin, end, device=held.device), len(markers))
            if seconds is None or len(markers) < 2:
                return solve(markers.double(), *self._scaled(fps), pull).to(markers.dtype)
            rate, rows = frame_grid(seconds, fps)
            rows = rows.to(markers.device)
            grid = markers.new_full((int(rows[-1]) + 1, *markers.shape[1:]), torch.nan, dtype=torch.float64)
            grid[rows] = markers.double()
            smoothness, huber_threshold = self._scaled(rate)
            # A finer grid has more second differences a second, and no more frames that show something.
            on_grid = None if pull is None else pull.at(rows, len(grid))
            return solve(grid, smoothness * fps / rate, huber_threshold, on_grid)[rows].to(markers.dtype)

    def _pull(self, frames: int, predicted: Tensor | None, gamma: Tensor | None) -> "Pull | None":
        if predicted is None or gamma is None:
            if predicted is not gamma:
                raise ShapeError("predicted and gamma: found one of them, expected both or none")
            return None
        check_predictions(predicted, gamma, (frames, len(self.markers.names)))
        counts = gamma > 0
        return Pull(torch.where(counts, predicted, 0.0).double(), gamma.double() / len(self.markers.rest))

    def energy(self, markers: Tensor, weights: Tensor, fps: float = REFERENCE_FPS) -> float:
        """What the solve minimises, over all frames, without predictions."""
        smoothness, huber_threshold = self._scaled(fps)
        solver = self.markers
        seen = solver.in_rig_space(markers.double())
        w = weights.double()
        points = solver.points(w)
        data = (points - seen).square().sum(-1).nan_to_num(0.0).sum() / points.shape[1]
        own = self.sparsity * w.sum() + penalty_value(solver.ridge) * w.square().sum()
        return float(data + own + smoothness * huber(w, huber_threshold))

    def _scaled(self, fps: float) -> tuple[float, float]:
        """A second difference of the same motion falls with the square of the frame rate."""
        check_rate(fps, "fps", ValueRangeError)
        return self.smoothness * (fps / REFERENCE_FPS) ** 4, self.huber_threshold * (REFERENCE_FPS / fps) ** 2

    def _solve(self, markers: Tensor, smoothness: float, huber_threshold: float, pull: "Pull | None") -> Tensor:
        r"""Splitting: a smooth problem without bounds, then what pulls each weight by itself, and a clamp.

        The smooth problem has one H and one Laplacian K in all frames. A cosine transform over time diagonalises K, the
        eigenvectors of H the rest, so a step is two transforms, products and a division. What differs from frame to
        frame is on its right side, updated by majorisation, which keeps the minimum: a marker that is not seen is
        filled in by the weights, and the part b of a second difference beyond :math:`\tau` is subtracted,
        :math:`h_\tau(d) = \min_b (d - b)^2 + 2\tau|b|`.

        Source: Boyd et al. 2011, section 5.2; Geman and Yang 1995 for b.
        """
        solver = self.markers
        seen = solver.in_rig_space(markers)
        rest, rows = solver.rest.double(), solver.basis.double().flatten(0, 1)
        count, shapes = len(rest), rows.shape[1]
        H = (2.0 / count) * (rows.T @ rows)
        H.diagonal().add_(2 * penalty_value(solver.ridge))
        smooth = SmoothProblem.of(H, len(seen), smoothness, huber_threshold)
        gaps = torch.isnan(seen).any(-1)
        seen_mask = ~gaps[..., None]
        offset = torch.where(seen_mask, rest - seen.nan_to_num(0.0), 0.0).flatten(1) @ rows * (2.0 / count)
        frames = gaps.any(-1).nonzero()[:, 0]
        hidden = gaps[frames].repeat_interleave(3, dim=1)
        z = seen.new_zeros(len(seen), shapes)
        penalty = self.sparsity

        def slope(z: Tensor) -> Tensor:
            f = offset + penalty
            if len(frames):
                f[frames] -= (torch.where(hidden, z[frames] @ rows.T, 0.0) @ rows) * (2.0 / count)
            return f

        return smooth.least(slope, z, torch.zeros_like(z), pull)[0]

    def _solve_corrected(
        self, markers: Tensor, smoothness: float, huber_threshold: float, pull: "Pull | None"
    ) -> Tensor:
        """With correctives: steps to the least of the problem above, with the mean frame's H in place of each frame's.

        A step is taken as far as the energy falls. The start is each frame's own solution.
        """
        solver = with_sparsity(self.markers, self.sparsity)
        data = _TakeData.of(solver, markers)
        rows = frames_seen(markers)
        w = interpolated(solver(markers[rows].float()), rows, len(markers)).double()  # a start needs no more digits
        H = data.hessian(w)
        smooth = SmoothProblem.of(H, len(w), smoothness, huber_threshold)
        dual = torch.zeros_like(w)

        def value_of(w: Tensor) -> float:
            pulled = 0.0 if pull is None else float((pull.weight * (w - pull.goal).square()).sum())
            return data.value(w) + smoothness * float(huber(w, huber_threshold)) + pulled

        value = value_of(w)
        for _ in range(_CORRECTED_STEPS):
            f = data.gradient(w) - w @ H
            found, dual = smooth.least(lambda _, f=f: f, w, dual, pull)  # type: ignore[misc]
            step, length = found - w, 1.0
            for _ in range(_HALVINGS):
                there = w + length * step
                reached = value_of(there)
                if reached < value:
                    break
                length *= 0.5
            else:
                break
            fallen, value, w = value - reached, reached, there
            if fallen < _LEAST_FALL * value:
                break
        return w

    def extra_repr(self) -> str:
        return f"smoothness={self.smoothness:g}, huber_threshold={self.huber_threshold:g}, sparsity={self.sparsity:g}"


def with_sparsity(solver: MarkerSolver, sparsity: float) -> MarkerSolver:
    """The same solver with another sparsity."""
    other = copy.copy(solver)
    # A learned sparsity of the solver is a parameter or a buffer of its own, and stays with it.
    other._parameters = {name: value for name, value in solver._parameters.items() if name != "sparsity"}
    other._buffers = {name: value for name, value in solver._buffers.items() if name != "sparsity"}
    other.sparsity = float(sparsity)
    other.regularization(solver.rest)
    return other


@dataclass(frozen=True, eq=False)
class _TakeData:
    """What markers ask of each frame of a rig with correctives, over all M markers, seen or not."""

    solver: MarkerSolver
    # Of frames that show all; None where a frame has gaps, whose residuals are then formed anew.
    energy: CorrectiveEnergy | None
    seen: Tensor  # in rig space, (T,M,3)

    @staticmethod
    def of(solver: MarkerSolver, markers: Tensor) -> "_TakeData":
        whole = None if bool(torch.isnan(markers).any()) else solver.complete_energy(markers)
        energy = whole if isinstance(whole, CorrectiveEnergy) else None
        return _TakeData(solver, energy, solver.in_rig_space(markers))

    def value(self, weights: Tensor) -> float:
        if self.energy is not None:
            return float(self.energy.value(weights).sum())
        own = self.solver.regularization(weights).value(weights).sum()
        return float(self._residual(weights).square().sum() / self.seen.shape[1] + own)

    def gradient(self, weights: Tensor) -> Tensor:
        """(T,N) at weights (T,N)."""
        if self.energy is not None:
            return self.energy.gradient(weights)
        activation = self.solver.activation
        assert activation is not None
        rows = self.solver.every_basis.double().flatten(0, 1)
        slope = (2.0 / self.seen.shape[1]) * (self._residual(weights).flatten(1) @ rows)
        shapes = weights.shape[1]
        own = self.solver.regularization(weights)
        by_correctives = activation.slope(activation.derivative(weights), slope[:, shapes:])
        return slope[:, :shapes] + by_correctives + weights @ own.H + own.f

    def hessian(self, weights: Tensor) -> Tensor:
        """The mean of some frames' (N,N), as if they showed every marker."""
        some = weights[:: max(1, len(weights) // _HESSIAN_FRAMES)]
        whole = self.solver.complete_energy(torch.zeros(len(some), *self.seen.shape[1:]).to(weights))
        assert isinstance(whole, CorrectiveEnergy)
        return whole.linearised(some).H.mean(0)

    def _residual(self, weights: Tensor) -> Tensor:
        return (self.solver.points(weights) - self.seen).nan_to_num(0.0)
