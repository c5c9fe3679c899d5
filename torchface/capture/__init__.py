"""Blendshape weights from what cameras and marker systems saw."""

from torchface.capture.markers import HybridSolver, MarkerSolver

__all__ = ["HybridSolver", "MarkerSolver"]
