"""Blendshape weights from markers and from a classifier's predictions."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from torchface.capture.corrective_energy import CorrectiveEnergy, least_in_box
from torchface.capture.energy import Quadratic, chunks_of_frames, pull_term
from torchface.capture.markers.given_markers import frames_seen
from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.number_checks import LARGEST_WEIGHT, as_real, checked_number, checked_type
from torchface.optim.box_checks import default_tolerance
from torchface.optim.data_dependent import data_dependent
from torchface.take import Take, Track
from torchface.temporal import interpolated, savitzky_golay

GAMMA = 4.0  # largest weight of a prediction, mm² over all markers for a squared weight of 1


def gamma_curves(active: Tensor, maximum: float = GAMMA, window: int = 15, order: int = 2) -> Tensor:
    r"""The weight of a classifier's predictions in each frame, smoothed over time.

    Where it is active :math:`\gamma` is ``maximum``, elsewhere 0; smoothed over time, and kept in [0, ``maximum``],
    which the filter overshoots (a negative :math:`\gamma` would leave the energy without a minimum).

    Args:
        active: which shapes the classifier predicts in which frames, (T,N) bool.
        maximum: mm² over all markers for a squared weight of 1; of the order of the markers' squared error.
        window, order: of :func:`torchface.temporal.savitzky_golay`.

    Returns:
        :math:`\gamma`, (T,N) float32; exactly 0 where no frame of the window is active.

    Raises:
        ShapeError: ``active`` is not (T,N).
        ValueRangeError: a negative ``maximum``.

    Source: thesis 4.1.8.

    Example:
        >>> blinks = torch.zeros(60, 1, dtype=torch.bool)
        >>> blinks[25:40] = True
        >>> gamma = gamma_curves(blinks)
        >>> gamma[0].item(), round(gamma[32].item(), 1)
        (0.0, 4.0)
    """
    if active.ndim != 2:
        raise ShapeError(f"active: found {tuple(active.shape)}, expected (T,N)")
    checked_number("maximum", maximum, 0.0, LARGEST_WEIGHT)
    smooth = savitzky_golay(maximum * active.double(), window, order)
    # Rounding must not leave a weight where there is none.
    return torch.where(smooth < 1e-9 * maximum, 0.0, smooth).clamp(0.0, maximum).float()


class HybridSolver(nn.Module):
    r"""Solves markers for blendshape weights, some of which a classifier predicts.

    .. math::
        \min_{0 \le w \le 1} E(w) + \frac{1}{M} \sum_i \gamma_i (w_i - \tilde w_i)^2

    with the energy E of ``MarkerSolver``, which counts a marker; so :math:`\gamma` is in mm² over all M markers, as in
    the source. A frame whose :math:`\gamma` is zero gets the marker solver's own weights, bit for bit.

    Args:
        markers: the solver for frames with markers alone.

    Source: thesis 4.1.8, equation 38.

    Example:
        >>> from torchface import zoo
        >>> solver = zoo.get_model("marker_solver")
        >>> blink = solver.names.index("eyeBlinkLeft")
        >>> still = solver.points(torch.zeros(1, len(solver.names)))
        >>> predicted = torch.zeros(1, len(solver.names), dtype=torch.float64)
        >>> predicted[0, blink] = 1.0  # a classifier saw the eye shut, the markers did not
        >>> trust = torch.zeros_like(predicted)
        >>> trust[0, blink] = 1e6
        >>> round(HybridSolver(solver)(still, predicted, trust)[0, blink].item(), 2)
        1.0
    """

    def __init__(self, markers: MarkerSolver) -> None:
        super().__init__()
        self.markers = checked_type("markers", markers, MarkerSolver)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the weights."""
        return self.markers.names

    def energy(self, markers: Tensor, predicted: Tensor, gamma: Tensor) -> Quadratic | CorrectiveEnergy:
        """What the solve minimises for markers (B,M,3), predicted weights and gamma (B,N), float64."""
        energy = self.markers.energy(markers)
        return energy + pull_term(predicted.double(), gamma.double() / len(self.markers.labels))

    @data_dependent("torchface.onnx.SolverGraph, which `torchface export solver --hybrid` writes")
    def forward(self, markers: Tensor, predicted: Tensor, gamma: Tensor) -> Tensor:
        r"""Weights for markers and predictions.

        Args:
            markers: (B,M,3), millimetres, in the order of ``markers.labels``; NaN for not seen.
            predicted: :math:`\tilde w`, the classifier's prediction, (B,N); used only where :math:`\gamma > 0`.
            gamma: :math:`\gamma`, its weight, (B,N), mm² over all markers; see :func:`gamma_curves`.

        Returns:
            Weights in [0,1], (B,N), differentiable in markers and predictions.

        Raises:
            ShapeError: the shapes do not fit each other.
            ValueRangeError: a prediction that counts is NaN or outside [0,1], or a gamma is negative or not finite.
        """
        given = {"markers": markers, "predicted": predicted, "gamma": gamma}
        markers, predicted, gamma = (as_real(value, name) for name, value in given.items())
        check_predictions(predicted, gamma, (len(markers), len(self.names)))
        alone: Tensor = self.markers(markers)
        pulled = (gamma > 0).any(1).nonzero()[:, 0]
        if not len(pulled):
            return alone
        parts = []
        tolerance = default_tolerance(markers.dtype)
        for chunk in chunks_of_frames(pulled, len(self.names)):
            active = gamma[chunk] > 0
            energy = self.energy(markers[chunk], torch.where(active, predicted[chunk], 0.0), gamma[chunk])
            start = alone[chunk].double()
            lower, upper = torch.zeros_like(start[0]), torch.ones_like(start[0])
            parts.append(least_in_box(energy, start, lower, upper, tolerance).to(alone.dtype))
        return alone.index_copy(0, pulled, torch.cat(parts))

    def solve_take(self, take: Take, predicted: Track, gamma: Track) -> Take:
        """The take with weights solved from its markers and from predicted curves, matched by name.

        Shapes without a prediction are left to the markers. A frame without any marker gets weights between those of
        the frames before and after.

        Args:
            take: markers.
            predicted, gamma: (T,K,1) for any of the rig's shapes, both for the same ones.

        Raises:
            ShapeError: the curves have another number of frames than the take.
            NameMismatchError: labels or names that are not the solver's, or the take has no markers.
        """
        checked_type("take", take, Take)
        if take.markers is None or len(take) != len(predicted) or len(take) != len(gamma):
            raise ShapeError(
                f"hybrid solve: found {len(take)} frames of markers, {len(predicted)} of predictions, {len(gamma)} of "
                "gamma, expected the same number"
            )
        markers = self.markers.arrange(take.markers)
        rows = frames_seen(markers)
        curves = [in_rig_order(self.markers, track)[rows] for track in (predicted, gamma)]
        seen = self(markers[rows], *curves)
        weights = interpolated(seen, rows, len(markers))
        return replace(take, weights=Track(self.names, weights[..., None]))


def in_rig_order(solver: MarkerSolver, curves: Track) -> Tensor:
    """Curves (T,K,1) of some of a rig's shapes as (T,N) of all, 0 for the others.

    Raises:
        NameMismatchError: a name is not the rig's.
    """
    known = [name for name in solver.names if name in curves.names]
    unknown = [name for name in curves.names if name not in solver.names]
    if unknown:
        raise NameMismatchError(
            f"predicted curves: found {', '.join(unknown[:5])}, expected shapes of the rig: "
            f"{', '.join(solver.names[:5])}, ..."
        )
    values = curves.select(known).values[..., 0].to(solver.rest.device)
    rows = torch.tensor([solver.names.index(name) for name in known], dtype=torch.int64, device=values.device)
    return values.new_zeros(len(curves), len(solver.names)).index_copy(1, rows, values)


def check_predictions(predicted: Tensor, gamma: Tensor, wanted: tuple[int, int]) -> None:
    """Refuses predictions and weights of them that are not (T,N), or that no energy has a minimum with."""
    for name, found in (("predicted", predicted), ("gamma", gamma)):
        if tuple(found.shape) != wanted:
            raise ShapeError(f"{name}: found {tuple(found.shape)}, expected {wanted}")
    if not bool(((gamma >= 0) & (gamma <= LARGEST_WEIGHT)).all()):
        raise ValueRangeError(
            f"gamma: found negative, NaN or infinite numbers, expected finite ones of 0 to {LARGEST_WEIGHT:.0e}"
        )
    counts = predicted[gamma > 0]
    if not bool(((counts >= 0) & (counts <= 1)).all()):
        raise ValueRangeError("predicted: found weights outside [0,1] where gamma is positive")
