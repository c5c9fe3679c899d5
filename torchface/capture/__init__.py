"""Blendshape weights from what cameras and marker systems saw."""

from torchface.capture.markers import HelmetSolver, HybridSolver, MarkerSolver, align_take, fit_attachment, rest_residual

__all__ = ["HelmetSolver", "HybridSolver", "MarkerSolver", "align_take", "fit_attachment", "rest_residual"]
