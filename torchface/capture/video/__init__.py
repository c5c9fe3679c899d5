"""Head pose and blendshape weights from one ordinary camera without markers."""

from torchface.capture.video.frame_states import VideoSolution, VideoState
from torchface.capture.video.settings import VideoSettings
from torchface.capture.video.solve import VideoSolver
from torchface.capture.video.whole_take import solve_whole_take

__all__ = ["VideoSettings", "VideoSolution", "VideoSolver", "VideoState", "solve_whole_take"]
