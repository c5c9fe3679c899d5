"""Stages that video, scan and mark a head as real equipment does, with the truth beside it."""

from torchface.synthetic.stages.makeup_layout import MakeupLayout, makeup_layout
from torchface.synthetic.stages.marker_stage import Recording, StageFlaws, place_markers, record
from torchface.synthetic.stages.scanner import RawScan, ScannerSettings, eyes_closed, scan_head
from torchface.synthetic.stages.weight_curves import perform

__all__ = [
    "MakeupLayout",
    "RawScan",
    "Recording",
    "ScannerSettings",
    "StageFlaws",
    "eyes_closed",
    "makeup_layout",
    "perform",
    "place_markers",
    "record",
    "scan_head",
]
