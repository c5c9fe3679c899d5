"""Capture from 3D markers."""

from torchface.capture.markers.solve import MarkerSolver

__all__ = ["MarkerSolver"]
