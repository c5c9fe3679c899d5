"""Names of blendshapes: ARKit's 52, and tables to the names that other programs and standards use."""

from torchface.shape_names.arkit_names import (
    ANTAGONISTS,
    ARKIT,
    antagonists,
    arkit_sources,
    mapping,
    mirror,
    spelled_as,
)
from torchface.shape_names.arkit_names import near_names as near_names
from torchface.shape_names.name_tables import METAHUMAN, UNIFIED, VISEMES, VRM0, VRM1, ClipTable, TwinTable

__all__ = [
    "ANTAGONISTS",
    "ARKIT",
    "METAHUMAN",
    "UNIFIED",
    "VISEMES",
    "VRM0",
    "VRM1",
    "ClipTable",
    "TwinTable",
    "antagonists",
    "arkit_sources",
    "mapping",
    "mirror",
    "spelled_as",
]
