"""Head pose and blendshape weights from one ordinary camera without markers."""

from torchface.capture.video.frame_states import VideoSolution, VideoState
from torchface.capture.video.video_settings import VideoSettings
from torchface.capture.video.video_smoothing import solve_whole_take
from torchface.capture.video.video_solver import VideoSolver

__all__ = ["VideoSettings", "VideoSolution", "VideoSolver", "VideoState", "solve_whole_take"]
