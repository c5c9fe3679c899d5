"""Head pose and blendshape weights from one ordinary camera without markers."""

from torchface.capture.own_rig.face_measurements import CameraView, FaceMeasurements
from torchface.capture.own_rig.frame_states import VideoSolution, VideoState
from torchface.capture.own_rig.take_solve import solve_whole_take
from torchface.capture.own_rig.video_settings import VideoSettings
from torchface.capture.own_rig.video_solver import VideoSolver

__all__ = [
    "CameraView",
    "FaceMeasurements",
    "VideoSettings",
    "VideoSolution",
    "VideoSolver",
    "VideoState",
    "solve_whole_take",
]
