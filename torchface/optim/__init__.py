"""Solvers that know nothing of faces."""

from torchface.optim.box_qp import BoxQP, box_qp

__all__ = ["BoxQP", "box_qp"]
