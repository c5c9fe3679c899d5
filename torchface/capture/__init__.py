"""Blendshape weights from what cameras and marker systems saw."""

from torchface.capture.markers import MarkerSolver

__all__ = ["MarkerSolver"]
