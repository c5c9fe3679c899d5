"""The weights of a take by how the skin moves in its frames beside what its landmarks gave."""

from dataclasses import replace

from torch import Tensor

from torchface.capture.own_rig import VideoSolution
from torchface.capture.own_rig.skin_motion import skin_motion, unless_shut
from torchface.io.video.blank_video import BlankVideo
from torchface.progress import Progress
from torchface.temporal import savitzky_golay
from torchface.workflows.named_finders import part_finder
from torchface.workflows.track.take_solution import calm_window
from torchface.workflows.track.track_inputs import TrackInputs


def followed_weights(
    inputs: TrackInputs, solution: VideoSolution, resting: Tensor | None, progress: Progress
) -> Tensor:
    """Weights (T,N) by the skin of a take's frames; the solution's where there are no pictures, or too few.

    How far the face rests in each frame, (T,), is known where an expression was read.
    """
    clip, rig, count = inputs.clip, inputs.actor, len(solution.weights)
    if isinstance(clip, BlankVideo):
        return solution.weights
    motion = skin_motion(
        rig,
        clip.color_frames(),
        solution.weights,
        (solution.rotation, solution.translation),
        solution.solved,
        inputs.calibration,
        part_finder(),
        lambda frame: progress("following the skin", frame + 1, count),
    )
    if motion is None:
        return solution.weights
    window = calm_window(clip.fps, count)
    calm = motion if window is None else replace(motion, change=savitzky_golay(motion.change, window))
    weights = calm.applied(solution.weights, resting)
    return unless_shut(solution.weights, weights, rig.names, ~motion.deviation.isfinite())
