"""How much sparsity a solve wants: the paper's rule, and the experiment behind it."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.errors import ShapeError

ACTIVE = 0.01


@dataclass(frozen=True)
class SparsityTrial:
    """A solve at one sparsity, means over the frames.

    Args:
        sparsity: β, mm² a marker for a weight of 1.
        active: shapes whose weight exceeds 0.01.
        weight_sum: the sum of the weights.
        marker_error: root mean square distance of the markers, millimetres.
        weight_error: root mean square error of the weights, where the truth is known.
    """

    sparsity: float
    active: float
    weight_sum: float
    marker_error: float
    weight_error: float | None = None


def sparsity_experiment(
    solver: MarkerSolver, markers: Tensor, sparsities: Sequence[float], truth: Tensor | None = None
) -> list[SparsityTrial]:
    """Solves the same frames at several sparsities.

    Args:
        solver: everything but the sparsity.
        markers: (T,M,3), millimetres, NaN for not seen.
        sparsities: the values of β to try; 0 is the solve without.
        truth: the true weights, (T,N), where they are known.

    Returns:
        One trial a value, in order.

    Source: thesis 4.1.4 and figure 74.
    """
    if truth is not None and truth.shape != (len(markers), len(solver.names)):
        raise ShapeError(f"truth: found {tuple(truth.shape)}, expected ({len(markers)},{len(solver.names)})")
    trials = []
    for sparsity in sparsities:
        trial = with_sparsity(solver, sparsity)
        weights = trial(markers)
        squared = _squared_marker_error(trial, markers, weights)
        error = None if truth is None else float((weights - truth.to(weights)).square().mean().sqrt())
        trials.append(
            SparsityTrial(
                float(sparsity),
                float((weights > ACTIVE).sum(-1).double().mean()),
                float(weights.sum(-1).mean()),
                squared**0.5,
                error,
            )
        )
    return trials


def sparsity_by_rule(solver: MarkerSolver, markers: Tensor) -> float:
    r"""The sparsity at which :math:`\beta \lVert w \rVert_1` is as large as the squared marker error.

    .. math:: \beta = \frac{\sum_t E_t}{\sum_t \lVert w_t \rVert_1}

    with the mean squared marker error E (mm² a marker) and the weights of the solve without sparsity.

    Args:
        solver: everything but the sparsity.
        markers: (T,M,3), a take that shows what the performer does.

    Source: thesis 4.1.4, on the value of β.
    """
    free = with_sparsity(solver, 0.0)
    weights = free(markers)
    return _squared_marker_error(free, markers, weights) / max(float(weights.sum(-1).mean()), 1e-9)


def with_sparsity(solver: MarkerSolver, sparsity: float) -> MarkerSolver:
    """The same solver with another sparsity."""
    other = copy.copy(solver)
    # A learned sparsity of the solver is a parameter or a buffer of its own, and stays with it.
    other._parameters = {name: value for name, value in solver._parameters.items() if name != "sparsity"}
    other._buffers = {name: value for name, value in solver._buffers.items() if name != "sparsity"}
    other.sparsity = float(sparsity)
    other.regularization(solver.rest)
    return other


def _squared_marker_error(solver: MarkerSolver, markers: Tensor, weights: Tensor) -> float:
    """Mean over the frames of the mean squared distance of seen markers, mm²."""
    return float(solver.squared_distance(markers, weights).mean())
