"""Videos of synthetic people who sit before a webcam, with the truth about every frame."""

from torchface.synthetic.stages.webcam.sitter import draw_sitter
from torchface.synthetic.stages.webcam.webcam_performance import (
    SittingSettings,
    WebcamPerformance,
    sitting,
    with_blinks,
)
from torchface.synthetic.stages.webcam.webcam_video import WebcamFrame, WebcamSettings, webcam_frames

__all__ = [
    "SittingSettings",
    "WebcamFrame",
    "WebcamPerformance",
    "WebcamSettings",
    "draw_sitter",
    "sitting",
    "webcam_frames",
    "with_blinks",
]
