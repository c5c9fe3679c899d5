"""Names of blendshapes: ARKit's 52, and tables to the names that other programs and standards use."""

from torchface.shape_names.arkit_names import (
    ANTAGONISTS,
    ARKIT,
    antagonists,
    arkit_name,
    arkit_sources,
    mapping,
    mirror,
    spelled_as,
)
from torchface.shape_names.arkit_names import near_names as near_names
from torchface.shape_names.arkit_names import read_as_arkit as read_as_arkit
from torchface.shape_names.name_tables import METAHUMAN, UNIFIED, VISEMES, VRM0, VRM1, ClipTable, TwinTable
from torchface.shape_names.pose_names import is_action_unit as is_action_unit
from torchface.shape_names.recognised_names import RecognisedShape, recognised_shapes
from torchface.shape_names.recognised_names import recognised_mapping as recognised_mapping
from torchface.shape_names.recognised_names import vowel_sources as vowel_sources

__all__ = [
    "ANTAGONISTS",
    "ARKIT",
    "METAHUMAN",
    "UNIFIED",
    "VISEMES",
    "VRM0",
    "VRM1",
    "ClipTable",
    "RecognisedShape",
    "TwinTable",
    "antagonists",
    "arkit_name",
    "arkit_sources",
    "mapping",
    "mirror",
    "recognised_shapes",
    "spelled_as",
]
