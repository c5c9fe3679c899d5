"""Facial action units from strokes of reflective paint, seen by a camera on the helmet."""

from torchface.capture.action_units.classifier import ActionUnitClassifier
from torchface.capture.action_units.classifier_training import TrainingSettings, fit_classifier
from torchface.capture.action_units.region_video import RegionVideo, read_regions
from torchface.capture.action_units.regions import GROUPS, RegionGroup
from torchface.capture.action_units.shape_table import ShapeTable, load_shape_table
from torchface.capture.action_units.weight_targets import ActionUnitCurves, CurveSettings, action_unit_curves, classify

# Training knows its model; a model knows of its training only here.
ActionUnitClassifier.fit = staticmethod(fit_classifier)

__all__ = [
    "GROUPS",
    "ActionUnitClassifier",
    "ActionUnitCurves",
    "CurveSettings",
    "RegionGroup",
    "RegionVideo",
    "ShapeTable",
    "TrainingSettings",
    "action_unit_curves",
    "classify",
    "fit_classifier",
    "load_shape_table",
    "read_regions",
]
