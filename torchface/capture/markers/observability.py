"""Observability of a rig's shapes by a layout of markers."""

from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.capture.weight_observability import Observability, weight_observability


def observability(solver: MarkerSolver, noise: float = 0.1) -> Observability:
    """What the markers of a solver can see of its rig; see :func:`weight_observability`.

    Args:
        solver: rig and attachment.
        noise: millimetres; a direction whose unit change moves the markers less is not seen.

    Source: thesis 4.1.4: the rank of B should be at least N.

    Example:
        >>> from torchface.synthetic import performer
        >>> from torchface import Attachment
        >>> rig = performer(texture=False)
        >>> chin = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks[[8]])
        >>> "browInnerUp" in observability(MarkerSolver(rig, chin)).unseen
        True
    """
    return weight_observability(solver.basis, solver.names, noise)
