"""Weights and head pose of the frames that landmarks tell of."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.capture.own_rig import VideoSolution, VideoSolver
from torchface.capture.own_rig.even_frames import even_times, solution_at, values_at
from torchface.capture.own_rig.video_smoothing import interpolated, solve_whole_take
from torchface.capture.own_rig.weight_walk import frame_intervals
from torchface.progress import Progress
from torchface.workflows.track.track_result import MIN_STABLE


def times_of(times: Tensor, count: int, fps: float) -> Tensor:
    """Times of as many frames as could be decoded: a file that was cut lacks some at its end."""
    more = times[-1] + torch.arange(1, max(count - len(times), 0) + 1, dtype=times.dtype) / fps
    return torch.cat([times, more])[:count]


def solved_weights(
    solver: VideoSolver,
    landmarks: Tensor,
    confidence: Tensor,
    whole_take: bool,
    progress: Progress,
    times: Tensor | None,
) -> VideoSolution:
    """What the landmarks tell; ``times`` (T,) say when frames are shown, evenly if absent."""
    enough = torch.isfinite(landmarks).all(-1).sum(1) >= MIN_STABLE
    if times is not None and solver.dynamics is not None:  # which has learned how faces go on in frames of one length
        even = even_times(times)
        points, trust = (values_at(x, times, even) for x in (landmarks, confidence))
        if bool((torch.isfinite(points).all(-1).sum(1) >= MIN_STABLE).any()):
            solution = solved_weights(solver, points, trust, whole_take, progress, None)
            return solution_at(solution, solver, even, times, landmarks, confidence, enough)
    if whole_take and solver.dynamics is not None:
        progress("solving for weights")
        return solve_whole_take(solver, landmarks, confidence=confidence)
    first = int(enough.nonzero()[0, 0])
    intervals = frame_intervals(times, len(landmarks), solver.settings.interval)
    states, state = [], solver.start()
    for t in range(first, len(landmarks)):  # a frame leans on the one before
        state = solver.step(state, landmarks[t], confidence=confidence[t], interval=intervals[t])
        states.append(state)
        progress("solving for weights", t + 1, len(landmarks))
    states = [states[0]] * first + states
    weights, rotation, translation = (
        torch.stack([getattr(one, name) for one in states]).detach().to(landmarks)
        for name in ("weights", "rotation", "translation")
    )
    if whole_take:
        weights = interpolated(weights, enough, times)
    errors = solver.reprojection_errors(landmarks, weights, rotation, translation)
    told = solver.shape_confidence(solver.landmark_trust(landmarks, confidence)).to(landmarks)
    return VideoSolution(weights, rotation, translation, errors, enough, told)
