"""Blendshape weights from what cameras and marker systems saw."""

from torchface.capture.action_units import ActionUnitClassifier, CurveSettings, action_unit_curves
from torchface.capture.anybody import ExampleSolver, WebcamControls, WebcamSolver
from torchface.capture.markers import (
    HelmetSolver,
    HybridSolver,
    MarkerSolver,
    WholeTakeSolver,
    align_take,
    clean_take,
    fit_attachment,
    rest_residual,
)
from torchface.capture.own_rig import VideoSolver
from torchface.capture.priors import DynamicsPrior, DynamicsSettings, ShapePrior
from torchface.capture.weight_readings import WeightReadings

__all__ = [
    "ActionUnitClassifier",
    "CurveSettings",
    "DynamicsPrior",
    "DynamicsSettings",
    "ExampleSolver",
    "HelmetSolver",
    "HybridSolver",
    "MarkerSolver",
    "ShapePrior",
    "VideoSolver",
    "WebcamControls",
    "WebcamSolver",
    "WeightReadings",
    "WholeTakeSolver",
    "action_unit_curves",
    "align_take",
    "clean_take",
    "fit_attachment",
    "rest_residual",
]
