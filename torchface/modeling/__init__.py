"""Faces as models: learned ones, personal rigs, and the detail that meshes are too coarse to hold."""

from torchface.modeling.detail import BakeStatistics, NormalMap, bake_normal_map, detail_maps
from torchface.modeling.scan_alignment import ScanAlignment, align_scan

__all__ = ["BakeStatistics", "NormalMap", "ScanAlignment", "align_scan", "bake_normal_map", "detail_maps"]
