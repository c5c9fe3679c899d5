"""Blendshape weights from what cameras and marker systems saw."""

from torchface.capture.markers import HybridSolver, MarkerSolver, align_take, fit_attachment, rest_residual

__all__ = ["HybridSolver", "MarkerSolver", "align_take", "fit_attachment", "rest_residual"]
