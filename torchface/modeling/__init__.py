"""Faces as models: learned ones, personal rigs, and the detail that meshes are too coarse to hold."""

from torchface.modeling.detail.normal_map_baking import (
    BakeSettings,
    BakeStatistics,
    NormalMap,
    bake_normal_map,
    detail_maps,
)
from torchface.modeling.detail.scan_alignment import ScanAlignment, align_scan
from torchface.modeling.morphable.head_model import HeadModel, Heads
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.modeling.morphable.published_models import head_model_of
from torchface.modeling.photographs.fit_settings import FitSettings
from torchface.modeling.photographs.image_fit import ImageFit, fit_images
from torchface.modeling.photographs.texture_fit import ColorFit, fit_colors
from torchface.modeling.photographs.texture_projection import PhotoTexture, photo_texture
from torchface.modeling.rigging.carried_shapes import CarriedShapes
from torchface.modeling.rigging.deformation_transfer import (
    TransferredRig,
    TransferReport,
    transfer_deformation,
    transfer_with_report,
)
from torchface.modeling.rigging.example_rigging import ExampleRig, RiggingSchedule, rig_from_examples
from torchface.modeling.rigging.expression_regression import ExpressionRegression, ExpressionSettings
from torchface.modeling.rigging.neutral_check import neutral_notes
from torchface.modeling.rigging.neutral_rig import NeutralRig, neutral_rig, rig_from_neutral
from torchface.modeling.rigging.open_eyed_neutral import open_eyes
from torchface.modeling.rigging.other_topology import shapes_on
from torchface.modeling.rigging.part_clearance import clear_parts
from torchface.modeling.rigging.part_placement import place_parts
from torchface.modeling.rigging.penetration import InnerParts, inner_parts, shape_depths
from torchface.modeling.rigging.sculpted_corrective import SculptedCorrective, corrective_from_sculpt

__all__ = [
    "BakeSettings",
    "BakeStatistics",
    "CarriedShapes",
    "ColorFit",
    "ExampleRig",
    "ExpressionRegression",
    "ExpressionSettings",
    "FitSettings",
    "HeadModel",
    "Heads",
    "ImageFit",
    "InnerParts",
    "MorphableModel",
    "NeutralRig",
    "NormalMap",
    "PhotoTexture",
    "RiggingSchedule",
    "ScanAlignment",
    "SculptedCorrective",
    "TransferReport",
    "TransferredRig",
    "align_scan",
    "bake_normal_map",
    "clear_parts",
    "corrective_from_sculpt",
    "detail_maps",
    "fit_colors",
    "fit_images",
    "head_model_of",
    "inner_parts",
    "neutral_notes",
    "neutral_rig",
    "open_eyes",
    "photo_texture",
    "place_parts",
    "rig_from_examples",
    "rig_from_neutral",
    "shape_depths",
    "shapes_on",
    "transfer_deformation",
    "transfer_with_report",
]
