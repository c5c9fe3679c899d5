"""The weights of a take by how the skin moves in its frames beside what its landmarks gave."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.capture.antagonist_shapes import signed_difference, signed_quantities
from torchface.capture.own_rig import VideoSolution
from torchface.capture.own_rig.skin_motion import skin_motion
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
    weights, signed = calm.applied(solution.weights, resting), signed_quantities(rig.names).to(solution.weights)
    # Skin does not show blinks: where one is solved, its lid does not rise.
    shut = ((solution.weights * ~motion.deviation.isfinite()) > 0).to(signed) @ signed.abs().T @ signed.abs() > 0
    return torch.where(shut, solution.weights, signed_difference(weights, signed))
