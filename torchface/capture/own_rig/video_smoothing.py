"""Blendshape weights of a whole video at once: every frame leans on those before and after it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.capture.own_rig.frame_states import FrameTerms, VideoSolution, VideoState
from torchface.capture.own_rig.reprojection import HeadState
from torchface.capture.own_rig.state_estimate import Expectation, StateEstimate
from torchface.capture.own_rig.video_solver import VideoSolver
from torchface.errors import ValueRangeError

# Added to variances before they are inverted: what rounding leaves of a direction that is known exactly.
_ROUNDING = 1e-9


def solve_whole_take(
    solver: VideoSolver,
    landmarks: Tensor,
    rotation: Tensor | None = None,
    translation: Tensor | None = None,
    confidence: Tensor | None = None,
) -> VideoSolution:
    r"""Weights and poses of consecutive frames, each from all of them.

    The solver runs forward; then what later frames tell goes back,

    .. math:: x_t \leftarrow x_t + G_t (x_{t+1} - x^-_{t+1}), \quad G_t = P_t (P^-_{t+1})^{-1}

    with :math:`x^-` what frame t led to; and each frame is solved anew for what all frames' landmarks together expect
    of it, under the prior and the bounds.

    Args:
        solver: with a dynamics prior; without one no frame tells of another.
        landmarks, rotation, translation, confidence: as of ``VideoSolver.forward``.

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
        states, enough = solver.states(landmarks, rotation, translation, confidence)
        first = int(enough.nonzero()[0, 0])
        smoothed = _smoothed(solver, states[first:])
        head = _solved(solver, states[first:], smoothed)
    frames = torch.arange(len(landmarks), device=landmarks.device)
    rows = (frames - first).clamp(min=0)  # frames before the first face have its state
    weights, turned, moved = (x[rows].to(landmarks.dtype) for x in (head.weights, head.rotation, head.translation))
    weights = interpolated(weights, enough)
    errors = solver.reprojection_errors(landmarks, weights, turned, moved)
    told = solver.shape_confidence(solver.landmark_trust(landmarks, confidence)).to(landmarks.dtype)
    return VideoSolution(weights, turned, moved, errors, enough, told)


def interpolated(weights: Tensor, solved: Tensor, seconds: Tensor | None = None) -> Tensor:
    """Weights (T,N) with straight lines where ``solved`` (T,) is false; at both ends they stay.

    ``seconds`` (T,) say when frames are shown; evenly if absent.
    """
    known = solved.nonzero()[:, 0]
    at = torch.arange(len(weights), device=weights.device)
    after = torch.searchsorted(known, at).clamp(max=len(known) - 1)
    before = (torch.searchsorted(known, at, right=True) - 1).clamp(min=0)
    left, right = known[before], known[after]
    when = at.double() if seconds is None else seconds.to(weights.device).double()
    length = when[right] - when[left]
    fraction = torch.where(length > 0, (when - when[left]) / length, 0.0).clamp(0, 1).to(weights)[:, None]
    return torch.lerp(weights[left], weights[right], fraction)


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
        lifted = following.mean.moved(following.mean.weights + ahead.residual[:, :-6], ahead.residual[:, -6:])
        surprise = Expectation(led_to.mean, led_to.covariance).residual(lifted)
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
    return StateEstimate(mean.moved(weights + residual[:, :-6], residual[:, -6:]), covariance)


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
        none[..., None].expand(-1, -1, 2),
        none,
        smoothed.mean.rotation,
        smoothed.mean.translation,
        expected,
    )
    return solver.solve(terms, HeadState(begin, smoothed.mean.rotation, smoothed.mean.translation)).head
