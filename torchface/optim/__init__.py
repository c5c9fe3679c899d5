"""Solvers, and a descent of networks, that know nothing of faces."""

from torchface.optim.box_qp import BoxQP, box_qp
from torchface.optim.fixed_splitting import FixedSplitting
from torchface.optim.gradient_descent import DescentRun, DescentSettings, DescentTask, descend
from torchface.optim.projected_gradient import ProjectedGradient
from torchface.optim.simplex_qp import SimplexQP, simplex_qp

__all__ = [
    "BoxQP",
    "DescentRun",
    "DescentSettings",
    "DescentTask",
    "FixedSplitting",
    "ProjectedGradient",
    "SimplexQP",
    "box_qp",
    "descend",
    "simplex_qp",
]
