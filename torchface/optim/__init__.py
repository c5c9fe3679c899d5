"""Solvers that know nothing of faces."""

from torchface.optim.box_qp import BoxQP, box_qp
from torchface.optim.simplex_qp import SimplexQP, simplex_qp

__all__ = ["BoxQP", "SimplexQP", "box_qp", "simplex_qp"]
