"""Capture from 3D markers."""

from torchface.capture.markers.attachment.attachment_fit import AttachmentFit, check_attachment, fit_attachment
from torchface.capture.markers.attachment.initial_sites import sites_by_shape
from torchface.capture.markers.attachment.site_uncertainty import SiteUncertainty
from torchface.capture.markers.cleaning.take_cleaning import Cleanup, Defect, clean_take
from torchface.capture.markers.helmet_motion import HelmetMotion
from torchface.capture.markers.helmet_solver import HelmetSolver
from torchface.capture.markers.hybrid_solver import HybridSolver, gamma_curves
from torchface.capture.markers.marker_labels import LabelMatch, match_labels, own_labels
from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.capture.markers.mesh_solver import MeshSolution, MeshSolver
from torchface.capture.markers.observability import observability
from torchface.capture.markers.rig_fit_check import FitCheck, check_fit
from torchface.capture.markers.take_alignment import align_take, rest_residual
from torchface.capture.markers.take_smoothing import WholeTakeSolver
from torchface.capture.weight_observability import Observability

__all__ = [
    "AttachmentFit",
    "Cleanup",
    "Defect",
    "FitCheck",
    "HelmetMotion",
    "HelmetSolver",
    "HybridSolver",
    "LabelMatch",
    "MarkerSolver",
    "MeshSolution",
    "MeshSolver",
    "Observability",
    "SiteUncertainty",
    "WholeTakeSolver",
    "align_take",
    "check_attachment",
    "check_fit",
    "clean_take",
    "fit_attachment",
    "gamma_curves",
    "match_labels",
    "observability",
    "own_labels",
    "rest_residual",
    "sites_by_shape",
]
