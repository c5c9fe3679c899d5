"""Faces as models: learned ones, personal rigs, and the detail that meshes are too coarse to hold."""

from torchface.modeling.color_casts import color_casts, texture_areas, without_cast
from torchface.modeling.detail import BakeStatistics, NormalMap, bake_normal_map, detail_maps
from torchface.modeling.example_rigging import ExampleRig, RiggingSchedule, rig_from_examples
from torchface.modeling.head_model import HeadModel, Heads
from torchface.modeling.image_fit import ImageFit, fit_images
from torchface.modeling.image_solve import FitSettings
from torchface.modeling.model_quality import ModelQuality, model_quality
from torchface.modeling.morphable import MorphableModel
from torchface.modeling.open_eyes import open_eyes
from torchface.modeling.part_clearance import clear_parts
from torchface.modeling.part_placement import place_parts
from torchface.modeling.penetration import InnerParts, inner_parts, shape_depths
from torchface.modeling.personalization import ExpressionRegression, rig_from_neutral
from torchface.modeling.photo_texture import PhotoTexture, photo_texture
from torchface.modeling.scan_alignment import ScanAlignment, align_scan
from torchface.modeling.sequence_fit import fit_sequence
from torchface.modeling.texture import ColorFit, fit_colors
from torchface.modeling.transfer import TransferredRig, TransferReport, transfer_deformation, transfer_with_report

__all__ = [
    "BakeStatistics",
    "ColorFit",
    "ExampleRig",
    "ExpressionRegression",
    "FitSettings",
    "HeadModel",
    "Heads",
    "ImageFit",
    "InnerParts",
    "ModelQuality",
    "MorphableModel",
    "NormalMap",
    "PhotoTexture",
    "RiggingSchedule",
    "ScanAlignment",
    "TransferReport",
    "TransferredRig",
    "align_scan",
    "bake_normal_map",
    "clear_parts",
    "color_casts",
    "detail_maps",
    "fit_colors",
    "fit_images",
    "fit_sequence",
    "inner_parts",
    "model_quality",
    "open_eyes",
    "photo_texture",
    "place_parts",
    "rig_from_examples",
    "rig_from_neutral",
    "shape_depths",
    "texture_areas",
    "transfer_deformation",
    "transfer_with_report",
    "without_cast",
]
