"""The weight of the L1 penalty by the paper's rule."""

from torch import Tensor

from torchface.capture import MarkerSolver
from torchface.capture.markers.take_smoothing import with_sparsity


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
    squared = float(free.squared_distance(markers, weights).mean())
    return squared / max(float(weights.sum(-1).mean()), 1e-9)
