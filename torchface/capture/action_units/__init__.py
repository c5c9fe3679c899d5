"""Facial action units from strokes of reflective paint, seen by a camera on the helmet."""

from torchface.capture.action_units.classifier import ActionUnitClassifier, TrainingSettings
from torchface.capture.action_units.painted_regions import GROUPS, RegionGroup
from torchface.capture.action_units.region_video import RegionVideo, read_regions
from torchface.capture.action_units.shape_table import ShapeTable, load_shape_table
from torchface.capture.action_units.weight_targets import ActionUnitCurves, CurveSettings, action_unit_curves, classify

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
    "load_shape_table",
    "read_regions",
]
