"""Capture from 3D markers."""

from torchface.capture.markers.hybrid import HybridSolver, gamma_curves
from torchface.capture.markers.observability import Observability, observability
from torchface.capture.markers.solve import MarkerSolver
from torchface.capture.markers.sparsity import SparsityTrial, sparsity_by_rule, sparsity_experiment

__all__ = [
    "HybridSolver",
    "MarkerSolver",
    "Observability",
    "SparsityTrial",
    "gamma_curves",
    "observability",
    "sparsity_by_rule",
    "sparsity_experiment",
]
