"""Estimates the fixed offsets between a rig's landmarks and a finder's from a take, without eating its expressions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.capture.own_rig.face_points import JAW, LANDMARKS
from torchface.capture.own_rig.frame_states import FrameTerms
from torchface.capture.own_rig.gauss_newton import HeadState, linearise
from torchface.capture.own_rig.head_pose import measure_poses
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets, offset_shares
from torchface.capture.own_rig.state_estimate import Expectation
from torchface.capture.own_rig.video_solver import VideoSolver
from torchface.capture.priors import ShapePrior
from torchface.errors import AlignmentError
from torchface.optim.box_qp import box_qp

_FRAMES, _ROUNDS, _REWEIGHTINGS = 40, 3, 3
_STABLE = 10
# Standard deviations of offsets to each other, millimetres: finders put the contour where the head's edge is, and brows
# where hair is; eyes, nose and lips are drawn sharply. How large they are altogether is estimated from the take.
_CONTOUR, _BROWS, _INNER = 5.0, 3.0, 2.0
_LEAST_SCALE, _MOST_SCALE = 0.02, 2.0
_RESEMBLANCE = 1.5  # people differ from rigs more along what expressions move, which is left out of the measure
_MODEL_ERROR = 0.5  # millimetres; what no constant expression and no offset explains of the mean residual
_PENALTY, _SOFTENING = 6.0, 0.1
_PRIOR = 0.3
_LEAST_NOISE, _NOISE_FACTOR = 0.015, 2.0
_FREE = 1e3


@dataclass(frozen=True, eq=False)
class _Mean:
    """What all frames together say of a constant expression (N) and of offsets (204), the heads' poses left to each.

    Args:
        H, gradient: of half the squared residual, in units of ``_MODEL_ERROR``, (N+204,N+204) and (N+204,).
        weights: the frames' mean, (N,).
        scale: how large offsets are beside what is expected of them.
        noise: what varies of residuals, standard deviation as a share of the eyes' distance.
    """

    H: Tensor
    gradient: Tensor
    weights: Tensor
    scale: float
    noise: float


def estimate_offsets(
    solver: VideoSolver,
    landmarks: Tensor,
    confidence: Tensor | None = None,
    rig: str = "",
    finder: str = "",
) -> LandmarkOffsets | None:
    r"""The offsets of a rig's landmarks that a take shows, jointly with its poses and weights.

    A residual that stays the same in all frames is a fixed offset, or an expression that never ends. Both are looked
    for at once, and each is paid for once and not once a frame,

    .. math::
        \min_{0 \le \bar w \le 1,\, o} \; \tfrac{1}{2T\mu^2} \sum_t \lVert P_t (r_t + J_t (\bar w - \bar w_0)
        + G_t (o - o_0)) \rVert^2 + \tfrac{1}{2 s^2} \sum_l \frac{\lVert o_l \rVert^2}{\sigma_l^2}
        + \beta \sum_i \frac{\bar w_i}{1 + \bar w^-_i / \varepsilon}

    with :math:`P_t` what no pose explains. The penalty falls for weights that are large already
    (:math:`\bar w^-`), so that it takes little from a smile of the whole take, while small weights of shapes that
    hardly move a landmark go to the offsets. How large offsets are, s, comes from the part of the mean residual that no
    expression explains: where rig and finder agree, there are next to none. Then the frames are solved anew.

    Args:
        solver: of the rig, without offsets; its prior holds for the frames.
        landmarks: (T,68,2), pixels of images without distortion; NaN for not seen.
        confidence: how far each is trusted, (T,68) in [0,1].
        rig, finder: digests to be kept with the offsets.

    Returns:
        The offsets and the noise that is left; None where fewer than ten frames show a face, which are too few
        an expression from an offset.

    Source: Candès, Wakin and Boyd 2008 for the penalty.
    """
    trust = solver.landmark_trust(landmarks, confidence)
    shown = ((trust > 0).sum(1) >= LANDMARKS // 2).nonzero()[:, 0]
    if len(shown) < _STABLE:
        return None
    chosen = shown[torch.linspace(0, len(shown) - 1, min(_FRAMES, len(shown))).round().long()]
    with torch.no_grad():
        return _estimated(solver, landmarks[chosen].double(), trust[chosen], rig, finder)


def _estimated(solver: VideoSolver, landmarks: Tensor, trust: Tensor, rig: str, finder: str) -> LandmarkOffsets | None:
    count = len(solver.names)
    noise = max(solver.settings.relative_noise, _LEAST_NOISE)
    offsets = LandmarkOffsets(landmarks.new_zeros(LANDMARKS, 3), noise, rig, finder)
    try:
        poses = measure_poses(solver.points.rest[:LANDMARKS], landmarks, solver.intrinsics.double(), trust)
    except AlignmentError:
        return None
    landmarks, trust = landmarks[poses.found], trust[poses.found]
    if len(landmarks) < _STABLE:
        return None
    head = HeadState(
        landmarks.new_zeros(len(landmarks), count), poses.rotation[poses.found], poses.translation[poses.found]
    )
    deviations = landmarks.new_full((LANDMARKS,), _INNER)
    deviations[:JAW], deviations[JAW : JAW + 10] = _CONTOUR, _BROWS
    scale, expression = 1.0, None
    for begun in range(_ROUNDS):
        shifted = solver.shifted(offsets)
        head, mean = _mean_problem(shifted, landmarks, trust, head, deviations)
        if begun == 0:
            scale = mean.scale
        offsets, expression = _split(mean, offsets, expression, scale * deviations, solver.prior)
    return offsets.rounded()


def _split(
    mean: _Mean,
    before: LandmarkOffsets,
    expression: Tensor | None,
    deviations: Tensor,
    prior: ShapePrior | None,
) -> tuple[LandmarkOffsets, Tensor]:
    """The mean residual as offsets and a constant expression, (N,)."""
    count = len(mean.weights)
    here = torch.cat([mean.weights, before.millimetres.flatten()])
    f = mean.gradient - mean.H @ here
    precision = deviations.square().reciprocal().repeat_interleave(3)
    H = mean.H + torch.cat([torch.full_like(mean.weights, 1e-3), precision]).diag()
    upper = torch.cat([torch.ones_like(mean.weights), torch.full_like(precision, _FREE)])
    lower = torch.cat([torch.zeros_like(mean.weights), torch.full_like(precision, -_FREE)])
    solution = here
    for _ in range(_REWEIGHTINGS):  # each penalty is by the weights that the one before led to
        falls = 1.0 if expression is None else 1 / (1 + expression / _SOFTENING)
        penalty = torch.nn.functional.pad(_PENALTY * falls * torch.ones_like(mean.weights), (0, len(precision)))
        likely = H
        if prior is not None:
            learned = prior.energy((mean.weights if expression is None else expression)[None])
            beside = (0, len(precision))
            likely = H + _PRIOR / prior.strength * torch.nn.functional.pad(learned.H[0], 2 * beside)
            penalty = penalty + _PRIOR / prior.strength * torch.nn.functional.pad(learned.f[0], beside)
        solution = box_qp(likely, (f + penalty)[None], lower, upper)[0]
        expression = solution[:count]
    noise = min(mean.noise, before.noise)
    return replace(before, millimetres=solution[count:].view(-1, 3), noise=noise), solution[:count]


def _mean_problem(
    solver: VideoSolver, landmarks: Tensor, trust: Tensor, start: HeadState, deviations: Tensor
) -> tuple[HeadState, _Mean]:
    """The frames (B,68,2) solved from a start, and what their residuals have in common."""
    count = len(solver.names)
    noise = solver.noise(start.rotation, start.translation)
    weight = solver.landmark_weights.double() * trust
    precision = weight.sqrt() / noise[:, None]
    known_landmarks = landmarks.nan_to_num(0.0)
    information = solver.initial_information.double().diag().expand(len(known_landmarks), -1, -1)
    terms = FrameTerms(known_landmarks, precision, start.rotation, start.translation, Expectation(start, information))
    head, rows = solver.solve(terms, start)
    K = solver.intrinsics.double()
    at = linearise(solver.points, head, rows, K, known_landmarks, precision, solver.settings.contour_slide)
    residual, jacobian = at.residual.flatten(1), at.jacobian.flatten(1, 2)
    by_place = at.jacobian[..., -3:] @ head.rotation[:, None]  # in the rig's own axes
    shares = offset_shares(solver.names, head.weights)
    by_offset = torch.einsum("tlcx,tlm->tlcmx", by_place, shares).flatten(3, 4).flatten(1, 2)
    by_both = torch.cat([jacobian[..., :count], by_offset], dim=2)
    by_motion = jacobian[..., count:]
    left = by_both - by_motion @ torch.linalg.lstsq(by_motion, by_both).solution
    rest = residual - (by_motion @ torch.linalg.lstsq(by_motion, residual[..., None]).solution)[..., 0]
    # Frames that the solve explains badly count less.
    size = rest.square().mean(1)
    share = 1 / (1 + size / size.median().clamp(min=1e-12))
    share = share / share.sum()
    # A residual of 1 is the frames' noise, in millimetres on the head:
    unit = float((noise * head.translation[:, 2]).median() / K[0, 0])
    factor = (unit / _MODEL_ERROR) ** 2
    H = factor * torch.einsum("t,tij,tik->jk", share, left, by_both)
    gradient = factor * torch.einsum("t,tij,ti->j", share, left, rest)
    mean = _Mean(
        0.5 * (H + H.T),
        gradient,
        share @ head.weights,
        _scale(share, residual, jacobian, weight, deviations / unit),
        _varying_noise(solver, residual, weight, share, head),
    )
    return head, mean


def _scale(share: Tensor, residual: Tensor, jacobian: Tensor, weight: Tensor, deviations: Tensor) -> float:
    """How large offsets are beside the deviations (68,), in units of the noise: by what no expression explains."""
    expected = (weight.mean(0).sqrt() * deviations).clamp(min=1e-3).repeat_interleave(2)
    mean = (share @ residual) / expected
    explained = torch.einsum("t,tij->ij", share, jacobian) / expected[:, None]
    basis = torch.linalg.qr(explained).Q
    beyond = mean - basis @ (basis.T @ mean)
    freedom = max(len(mean) - basis.shape[1], 1)
    return min(max(_RESEMBLANCE * float((beyond.square().sum() / freedom).sqrt()), _LEAST_SCALE), _MOST_SCALE)


def _varying_noise(solver: VideoSolver, residual: Tensor, weight: Tensor, share: Tensor, head: HeadState) -> float:
    """The noise that inner landmarks' residuals (B,136) show, as a share of the eyes' distance, on the safe side.

    What they have in common in all frames is no noise.
    """
    inner = (residual - share @ residual).unflatten(1, (LANDMARKS, 2))[:, JAW:]
    apart = solver.points.eyes_distance(head.rotation, head.translation, solver.intrinsics.double())
    unit = solver.noise(head.rotation, head.translation) / apart
    counts = weight[:, JAW:].mean(0) > 0.1
    sizes = (inner.square().mean(-1) / weight[:, JAW:].clamp(min=0.1) * unit[:, None].square())[:, counts]
    return max(_NOISE_FACTOR * float((share @ sizes).mean().sqrt()), _LEAST_NOISE)
