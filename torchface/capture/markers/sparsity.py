"""The weight of the L1 penalty by the paper's rule."""

from __future__ import annotations

import copy

from torch import Tensor

from torchface.capture.markers.marker_solver import MarkerSolver


def sparsity_by_rule(solver: MarkerSolver, markers: Tensor) -> float:
    r"""The sparsity at which :math:`\beta \lVert w \rVert_1` is as large as the squared marker error.

    .. math:: \beta = \frac{\sum_t E_t}{\sum_t \lVert w_t \rVert_1}

    with the mean squared marker error E (mm² a marker) and the weights of the solve without sparsity.

    Args:
        solver: everything but the sparsity.
        markers: (T,M,3), a take that shows what the performer does.

    Source: thesis 4.1.4, on the value of β.

    Example:
        >>> from torchface import zoo
        >>> solver = zoo.get_model("marker_solver")
        >>> noise = torch.randn(20, len(solver.labels), 3, generator=torch.Generator().manual_seed(0))
        >>> quiet, loud = (solver.points(torch.full((20, 51), 0.3)) + size * noise for size in (0.1, 0.5))
        >>> sparsity_by_rule(solver, quiet) < sparsity_by_rule(solver, loud)
        True
    """
    free = with_sparsity(solver, 0.0)
    weights = free(markers)
    squared = float(free.squared_distance(markers, weights).mean())
    return squared / max(float(weights.sum(-1).mean()), 1e-9)


def with_sparsity(solver: MarkerSolver, sparsity: float) -> MarkerSolver:
    """The same solver with another sparsity."""
    other = copy.copy(solver)
    # A learned sparsity of the solver is a parameter or a buffer of its own, and stays with it.
    other._parameters = {name: value for name, value in solver._parameters.items() if name != "sparsity"}
    other._buffers = {name: value for name, value in solver._buffers.items() if name != "sparsity"}
    other.sparsity = float(sparsity)
    other.regularization(solver.rest)
    return other
