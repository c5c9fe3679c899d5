"""Uneven frames brought to an even rate, for what counts in frames of one length, and what was solved brought back."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.capture.own_rig.frame_states import VideoSolution
from torchface.capture.own_rig.video_solver import VideoSolver
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix, rotation_vector


def even_times(seconds: Tensor) -> Tensor:
    """As many times as of frames (T,), rising, the first and last the same, evenly between: their mean rate's.

    Raises:
        ShapeError: ``seconds`` is not (T,).
        ValueRangeError: they do not rise.
    """
    if seconds.ndim != 1 or not len(seconds):
        raise ShapeError(f"seconds: found {tuple(seconds.shape)}, expected (T,) of a frame at least")
    seconds = seconds.double()
    if not bool((seconds.diff() > 0).all()):
        raise ValueRangeError("seconds: found times that do not rise, expected rising ones")
    steps = torch.arange(len(seconds), dtype=torch.float64, device=seconds.device) / max(len(seconds) - 1, 1)
    return torch.lerp(seconds[0], seconds[-1], steps)


def values_at(values: Tensor, seconds: Tensor, times: Tensor) -> Tensor:
    """Values (T,...) of frames shown at ``seconds`` (T,) at other ``times`` (S,), on straight lines between, (S,...).

    A value is NaN where one of the two frames beside it is NaN, and is the nearest frame's outside of them.
    """
    before, fraction = _beside(seconds, times)
    fraction = fraction.to(values).reshape(-1, *[1] * (values.ndim - 1))
    here, after = values[before], values[(before + 1).clamp(max=len(values) - 1)]
    return torch.where(fraction == 0, here, torch.where(fraction == 1, after, torch.lerp(here, after, fraction)))


def rotations_at(rotations: Tensor, seconds: Tensor, times: Tensor) -> Tensor:
    """Rotations (T,3,3) of frames shown at ``seconds`` (T,) at other ``times`` (S,), turning evenly between."""
    before, fraction = _beside(seconds, times)
    here, after = rotations[before].double(), rotations[(before + 1).clamp(max=len(rotations) - 1)].double()
    turn = rotation_vector(here.transpose(1, 2) @ after) * fraction.to(here)[:, None]
    return (here @ rotation_matrix(turn)).to(rotations)


def solution_at(
    solution: VideoSolution,
    solver: VideoSolver,
    seconds: Tensor,
    times: Tensor,
    landmarks: Tensor,
    confidence: Tensor,
    solved: Tensor,
) -> VideoSolution:
    """What was solved of frames shown at ``seconds`` (S,) at other ``times`` (T,).

    Args:
        solution: of S frames.
        solver: that solved it.
        seconds, times: rising.
        landmarks, confidence: of the T frames, (T,68,2) and (T,68); errors and confidences are theirs.
        solved: which of the T frames showed a face, (T,) bool.
    """
    weights, translation = (values_at(x, seconds, times) for x in (solution.weights, solution.translation))
    rotation = rotations_at(solution.rotation, seconds, times)
    errors = solver.reprojection_errors(landmarks, weights, rotation, translation)
    told = solver.shape_confidence(solver.landmark_trust(landmarks, confidence)).to(landmarks)
    return VideoSolution(weights, rotation, translation, errors, solved, told)


def _beside(seconds: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Of each time the frame before it, and how far on to the next it is, in [0,1]."""
    seconds, times = seconds.double(), times.double()
    before = (torch.searchsorted(seconds, times, right=True) - 1).clamp(0, max(len(seconds) - 2, 0))
    length = seconds[(before + 1).clamp(max=len(seconds) - 1)] - seconds[before]
    return before, torch.where(length > 0, (times - seconds[before]) / length, 0.0).clamp(0, 1)
