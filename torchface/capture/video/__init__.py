"""Head pose and blendshape weights from one ordinary camera without markers."""

from torchface.capture.video.solve import VideoSolution, VideoSolver, VideoState

__all__ = ["VideoSolution", "VideoSolver", "VideoState"]
