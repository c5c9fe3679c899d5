"""The solve of a whole take: frame after frame or from all frames at once, at even times or at the frames' own."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.own_rig.face_measurements import FaceMeasurements
from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.capture.own_rig.frame_states import FrameTerms, VideoSolution, VideoState
from torchface.capture.own_rig.gauss_newton import HeadState
from torchface.capture.own_rig.state_estimate import StateEstimate
from torchface.capture.own_rig.video_solver import VideoSolver
from torchface.capture.own_rig.weight_walk import frame_intervals
from torchface.errors import ValueRangeError
from torchface.geometry.rotations import rotation_matrix, rotation_vector
from torchface.progress import Progress
from torchface.temporal.interpolation import frames_beside, values_at

# Added to variances before they are inverted: what rounding leaves of a direction that is known exactly.
_ROUNDING = 1e-9


def solve_take(
    solver: VideoSolver,
    landmarks: Tensor,
    confidence: Tensor,
    seconds: Tensor | None = None,
    whole_take: bool = False,
    progress: Progress | None = None,
    measured: FaceMeasurements | None = None,
) -> VideoSolution:
    """Weights and poses of a take, as ``torchface track`` solves it.

    A dynamics prior has learned how faces go on in frames of one length: with one, uneven frames are solved at their
    mean rate and what was solved is read off at their own times.

    Args:
        landmarks: (T,68,2), pixels; NaN for not seen.
        confidence: how far each landmark is trusted, (T,68) in [0,1].
        seconds: when each frame is shown, (T,), rising; even if absent.
        whole_take: each frame is solved from all frames, with a dynamics prior; without one, frames that show no face
            lie between those before and after.
    """
    if seconds is not None and solver.dynamics is not None:
        frame_intervals(seconds, len(landmarks), solver.settings.interval)  # checks them
        even = even_times(seconds)
        points, trust = (values_at(x, seconds, even) for x in (landmarks, confidence))
        there = None if measured is None else measured.of_frames(frames_beside(seconds, even)[0])
        if bool(solver.shows_face(points, trust, () if there is None else there.views).any()):
            solution = solve_take(solver, points, trust, None, whole_take, progress, there)
            weights, translation = (values_at(x, even, seconds) for x in (solution.weights, solution.translation))
            rotation = rotations_at(solution.rotation, even, seconds)
            return solver.solution(landmarks, confidence, weights, rotation, translation, measured)
    if whole_take and solver.dynamics is not None:
        return solve_whole_take(solver, landmarks, confidence=confidence, progress=progress, measured=measured)
    with torch.no_grad():
        solution = solver(landmarks, confidence=confidence, seconds=seconds, progress=progress, measured=measured)
    if not whole_take or bool(solution.solved.all()):
        return solution
    when = torch.arange(len(landmarks), device=landmarks.device) if seconds is None else seconds
    weights = values_at(solution.weights[solution.solved], when[solution.solved], when)
    return solver.solution(landmarks, confidence, weights, solution.rotation, solution.translation, measured)


def solve_whole_take(
    solver: VideoSolver,
    landmarks: Tensor,
    rotation: Tensor | None = None,
    translation: Tensor | None = None,
    confidence: Tensor | None = None,
    progress: Progress | None = None,
    measured: FaceMeasurements | None = None,
) -> VideoSolution:
    r"""Weights and poses of consecutive frames, each from all of them.

    The solver runs forward; then what later frames say goes back,

    .. math:: x_t \leftarrow x_t + G_t (x_{t+1} - x^-_{t+1}), \quad G_t = P_t (P^-_{t+1})^{-1}

    with :math:`x^-` what frame t led to; and each frame is solved anew for what all frames' landmarks together expect
    of it, under the prior and the bounds.

    Args:
        solver: with a dynamics prior; without one no frame says anything of another.
        landmarks, rotation, translation, confidence, progress, measured: as of ``VideoSolver.forward``.

    Raises:
        ShapeError: the shapes do not fit each other.
        ValueRangeError: the solver has no dynamics prior, or as ``VideoSolver.forward``.

    Source: Rauch, Tung and Striebel 1965.

    Example:
        >>> from torchface import zoo
        >>> from torchface.capture import VideoSolver
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> camera = torch.tensor([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
        >>> head = rig.vertices[rig.neutral.landmarks] * torch.tensor([1.0, -1, -1]) + torch.tensor([0.0, 0, 700])
        >>> pixels = (900 * head[:, :2] / head[:, 2:] + torch.tensor([320.0, 240.0])).repeat(3, 1, 1)
        >>> pixels[1] = torch.nan  # a hand before the face
        >>> solver = VideoSolver(rig, None, camera, dynamics=zoo.get_model("dynamics_prior"))
        >>> found = solve_whole_take(solver, pixels)
        >>> bool((found.translation[1, 2] - 700).abs() < 20)
        True
    """
    if solver.dynamics is None:
        raise ValueRangeError("whole take: found a solver without a dynamics prior, expected one that has it")
    with torch.no_grad():
        given = landmarks, rotation, translation, confidence
        states, enough = solver.states(*given, progress=progress, measured=measured)
        first = int(enough.nonzero()[0, 0])
        smoothed = _smoothed(solver, states[first:])
        head = _solved(solver, states[first:], smoothed)
    frames = torch.arange(len(landmarks), device=landmarks.device)
    rows = (frames - first).clamp(min=0)  # frames before the first face have its state
    weights, turned, moved = (x[rows].to(landmarks.dtype) for x in (head.weights, head.rotation, head.translation))
    weights = values_at(weights[enough], frames[enough], frames)
    return solver.solution(landmarks, confidence, weights, turned, moved, measured)


def even_times(seconds: Tensor) -> Tensor:
    """As many times as of frames (T,), rising, the first and last the same, evenly between: their mean rate's."""
    seconds = seconds.double()
    steps = torch.arange(len(seconds), dtype=torch.float64, device=seconds.device) / max(len(seconds) - 1, 1)
    return torch.lerp(seconds[0], seconds[-1], steps)


def rotations_at(rotations: Tensor, seconds: Tensor, times: Tensor) -> Tensor:
    """Rotations (T,3,3) of frames shown at ``seconds`` (T,) at other ``times`` (S,), turning evenly between."""
    before, fraction = frames_beside(seconds, times)
    here, after = rotations[before].double(), rotations[(before + 1).clamp(max=len(rotations) - 1)].double()
    turn = rotation_vector(here.transpose(1, 2) @ after) * fraction.to(here)[:, None]
    return (here @ rotation_matrix(turn)).to(rotations)


@dataclass(frozen=True, eq=False)
class _Later:
    """The estimate of a frame from all of them: the residual from its own, (1,N+6), and the covariance, (1,N+6,N+6)."""

    residual: Tensor
    covariance: Tensor


def _smoothed(solver: VideoSolver, states: list[VideoState]) -> StateEstimate:
    """The estimates of T frames from all of them, as one over T faces."""
    estimates = [state.estimate for state in states if state.estimate is not None]
    later = [_Later(torch.zeros_like(estimates[-1].covariance[..., 0]), estimates[-1].covariance)]
    # Each frame needs what was found of the next.
    for state, estimate, following in zip(
        reversed(states[:-1]), reversed(estimates[:-1]), reversed(estimates[1:]), strict=True
    ):
        led_to = solver.predicted(state, estimate)
        gain = torch.linalg.solve(led_to.covariance, estimate.covariance).transpose(1, 2)
        ahead = later[-1]
        surprise = following.mean.stepped(ahead.residual).step_from(led_to.mean)
        residual = (gain @ surprise[..., None])[..., 0]
        covariance = estimate.covariance + gain @ (ahead.covariance - led_to.covariance) @ gain.transpose(1, 2)
        later.append(_Later(residual, 0.5 * (covariance + covariance.transpose(1, 2))))
    later.reverse()
    residual, covariance = (torch.cat([getattr(x, name) for x in later]) for name in ("residual", "covariance"))
    weights, rotation, translation = (
        torch.cat([getattr(estimate.mean, name) for estimate in estimates])
        for name in ("weights", "rotation", "translation")
    )
    mean = HeadState(weights, rotation, translation)
    return StateEstimate(mean.stepped(residual), covariance)


def _solved(solver: VideoSolver, states: list[VideoState], smoothed: StateEstimate) -> HeadState:
    """The frames' weights and poses under the prior; their landmarks are in what is expected already."""
    spread = smoothed.covariance
    identity = torch.eye(spread.shape[1], dtype=spread.dtype, device=spread.device)
    expected = StateEstimate(smoothed.mean, spread + _ROUNDING * identity).expectation()
    count = len(states)
    like = smoothed.mean.weights
    none = like.new_zeros(count, LANDMARKS)
    begin = torch.cat([state.weights[None] for state in states])
    terms = FrameTerms(
        none[..., None].expand(-1, -1, 2), none, smoothed.mean.rotation, smoothed.mean.translation, expected
    )
    head, _ = solver.solve(terms, HeadState(begin, smoothed.mean.rotation, smoothed.mean.translation))
    return head
