"""Videos of synthetic people who sit before a webcam, with the truth about every frame."""

from torchface.synthetic.stages.webcam.webcam_performance import (
    SittingSettings,
    WebcamPerformance,
    sitting,
    with_blinks,
    with_speech,
)
from torchface.synthetic.stages.webcam.webcam_video import WebcamFrame, WebcamSettings, webcam_frames

__all__ = [
    "SittingSettings",
    "WebcamFrame",
    "WebcamPerformance",
    "WebcamSettings",
    "sitting",
    "webcam_frames",
    "with_blinks",
    "with_speech",
]
