"""Which of the examples the landmarks of a picture tell apart."""

from __future__ import annotations

import torch

from torchface.capture.anybody.examples.example_solver import ExampleSolver
from torchface.capture.weight_observability import Observability, weight_observability


@torch.no_grad()
def landmark_observability(solver: ExampleSolver, noise: float = 0.5) -> Observability:
    """What 68 landmarks in a picture can see of a solver's examples; see :func:`weight_observability`.

    What the placement explains, where it is solved for, tells no shapes apart: so a head that tilts is not seen beside
    :class:`SolvedSimilarity`, which says the roll itself.

    Args:
        solver: examples and placement.
        noise: percent of the eyes' distance; a direction whose unit change moves the landmarks less drowns in it.

    Example:
        >>> from torchface.capture.anybody import paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> seen = landmark_observability(ExampleSolver(examples))
        >>> seen.rank <= seen.shapes == 15
        True
    """
    neutral = solver.neutral.double()
    equations = solver.equations(neutral[None])
    shapes = len(solver.names)
    columns = 100 * equations.columns()[0].flatten(0, 1)
    basis, free = columns[:, :shapes], columns[:, shapes:]
    if free.shape[1]:
        known = torch.linalg.qr(free)[0]
        basis = basis - known @ (known.T @ basis)
    return weight_observability(
        basis.unflatten(0, (68, 2)).to(solver.basis.dtype),
        solver.names,
        noise,
        "landmarks",
        "% of the eyes' distance",
    )
