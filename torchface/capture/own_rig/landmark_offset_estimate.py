"""Estimates the fixed offsets between a rig's landmarks and a finder's from a take, without eating its expressions."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchface.capture.energy import Quadratic
from torchface.capture.own_rig.face_points import JAW, LANDMARKS
from torchface.capture.own_rig.frame_states import FrameTerms
from torchface.capture.own_rig.gauss_newton import HeadState, linearise
from torchface.capture.own_rig.head_pose import measure_poses
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets, offset_shares
from torchface.capture.own_rig.resting_frames import activity_of_weights, resting_share
from torchface.capture.own_rig.state_estimate import Expectation
from torchface.capture.own_rig.video_solver import VideoSolver
from torchface.capture.weight_readings import LASTING, WeightReadings
from torchface.errors import AlignmentError, ValueRangeError
from torchface.geometry.similarity import similarity_transform
from torchface.optim.blas_threads import one_blas_thread
from torchface.optim.box_qp import box_qp

_SEARCHED, _FRAMES, _ROUNDS, _REWEIGHTINGS = 120, 40, 3, 3
_NEUTRAL = 5  # frames on each side of one that is neutral
_STABLE = 10
# Standard deviations of offsets to each other, millimetres: finders put the contour where the head's edge is, and brows
# where hair is; eyes, nose and lips are drawn sharply. How large they are altogether is estimated from the take.
_CONTOUR, _BROWS, _INNER = 5.0, 3.0, 2.0
_CONTOUR_HABIT, _BROWS_HABIT, _INNER_HABIT = 4.0, 2.0, 1.0  # the same of finders alone
_LEAST_SCALE, _MOST_SCALE = 0.02, 2.0
_RESEMBLANCE = 1.5  # people differ from rigs more along what expressions move, which is left out of the measure
_MODEL_ERROR = 0.5  # millimetres; what no constant expression and no offset explains of the mean residual
_PENALTY, _SOFTENING = 6.0, 0.1
_PRIOR = 0.3
_LEAST_NOISE, _NOISE_FACTOR = 0.015, 2.0
_FREE = 1e3


@dataclass(frozen=True, eq=False)
class _Mean:
    """What all frames together say of a constant expression (N) and of offsets (204), the heads' poses left to each."""

    read: Quadratic | None  # what the frames' readings say of the expression on average
    # H, gradient: of half the squared residual, in units of `_MODEL_ERROR`, (N+204,N+204) and (N+204,)
    H: Tensor
    gradient: Tensor
    weights: Tensor  # the frames' mean, (N,)
    scale: float  # how large offsets are beside what is expected of them
    noise: float  # what varies of residuals, standard deviation as a share of the eyes' distance


def estimate_offsets(
    solver: VideoSolver,
    landmarks: Tensor,
    confidence: Tensor | None = None,
    resting: Tensor | None = None,
    identity_modes: Tensor | None = None,
    neutral: int | None = None,
    read: WeightReadings | None = None,
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

    An expression of most of a take is none that never ends, so the sums are over frames in which the face rests: a
    twelfth of the frames, or more where more are alike. Where weights were read, the readings' mean, whose error is
    alike in all frames, says of the constant expression what the penalty only guesses. With modes of other people's
    heads, offsets are likely as far as those and the finder's habits explain them: no head has its lips apart at rest.

    Args:
        solver: of the rig, without offsets; its prior holds for the frames.
        landmarks: (T,68,2), pixels of images without distortion; NaN for not seen.
        confidence: how far each is trusted, (T,68) in [0,1].
        resting: how far the face rests in each frame, (T,) in [0,1]; found by solved weights if absent.
        identity_modes: what a standard deviation of each of K ways of being another person adds to the landmarks,
            (K,68,3), millimetres.
        neutral: a frame in which the face has no expression; those beside it are taken as like it.
        read: what networks read of the frames' weights.

    Returns:
        The offsets and the noise that is left; None where fewer than ten frames show a face, which are too few to know
        an expression from an offset.

    Source: Candès, Wakin and Boyd 2008 for the penalty.
    """
    trust = solver.landmark_trust(landmarks, confidence)
    seen = (trust > 0).sum(1) >= LANDMARKS // 2
    frames = torch.arange(len(landmarks), device=landmarks.device)
    if neutral is not None:
        if not 0 <= neutral < len(landmarks) or not bool(seen[neutral]):
            what = "no face in it" if 0 <= neutral < len(landmarks) else f"{len(landmarks)} frames"
            raise ValueRangeError(f"neutral frame {neutral}: found {what}, expected one that shows the face at rest")
        seen &= (frames - neutral).abs() <= _NEUTRAL
        resting = seen.double()
    shown = frames[seen]
    if len(shown) < (_STABLE if neutral is None else 1):
        return None
    chosen = shown[torch.linspace(0, len(shown) - 1, min(_SEARCHED, len(shown))).round().long()]
    likely = None if identity_modes is None else _likely_offsets(identity_modes.to(landmarks).double())
    with torch.no_grad(), one_blas_thread():
        rest = None if resting is None else resting[chosen].double()
        take = _Take(landmarks[chosen].double(), trust[chosen], rest, None if read is None else read.of_frames(chosen))
        return _estimated(solver, take, likely, neutral is not None)


@dataclass(frozen=True, eq=False)
class _Take:
    """Landmarks (B,68,2), how far they are trusted, (B,68), how far the face rests, (B,), and readings, where known."""

    landmarks: Tensor
    trust: Tensor
    resting: Tensor | None
    read: WeightReadings | None = None

    def of_frames(self, frames: Tensor) -> "_Take":
        if frames.dtype == torch.bool:
            frames = frames.nonzero()[:, 0]
        rest = None if self.resting is None else self.resting[frames]
        read = None if self.read is None else self.read.of_frames(frames)
        return _Take(self.landmarks[frames], self.trust[frames], rest, read)


def _likely_offsets(modes: Tensor) -> Tensor:
    """The covariance (204,204) of offsets by ways of being another person, (K,68,3), and by a finder's habits."""
    habits = modes.new_full((LANDMARKS,), _INNER_HABIT)
    habits[:JAW], habits[JAW : JAW + 10] = _CONTOUR_HABIT, _BROWS_HABIT
    moved = modes.flatten(1)
    return moved.T @ moved + habits.square().repeat_interleave(3).diag()


def _estimated(solver: VideoSolver, take: _Take, likely: Tensor | None, neutral: bool) -> LandmarkOffsets | None:
    noise = max(solver.settings.relative_noise, _LEAST_NOISE)
    offsets = LandmarkOffsets(take.landmarks.new_zeros(LANDMARKS, 3), noise)
    least = 1 if neutral else _STABLE
    try:
        poses = measure_poses(solver.points.rest[:LANDMARKS], take.landmarks, solver.intrinsics.double(), take.trust)
    except AlignmentError:
        return None
    if int(poses.found.sum()) < least:
        return None
    take = take.of_frames(poses.found)
    nothing = take.landmarks.new_zeros(len(take.landmarks), len(solver.names))
    head = HeadState(nothing, poses.rotation[poses.found], poses.translation[poses.found])
    if take.resting is None:
        head, _, _ = _solved(solver, take, head)
        take = replace(take, resting=resting_share(activity_of_weights(head.weights, solver.names)))
    assert take.resting is not None
    calm = take.resting.argsort(descending=True)[: max(_FRAMES, least)].sort().values
    take, head = take.of_frames(calm), HeadState(head.weights[calm], head.rotation[calm], head.translation[calm])
    if likely is None:
        deviations = take.landmarks.new_full((LANDMARKS,), _INNER)
        deviations[:JAW], deviations[JAW : JAW + 10] = _CONTOUR, _BROWS
        likely = deviations.square().repeat_interleave(3).diag()
    scale, expression = 1.0, None
    for begun in range(_ROUNDS):
        head, mean = _mean_problem(solver.shifted(offsets), take, head, likely)
        if begun == 0:
            scale = mean.scale
        offsets, expression = _split(mean, offsets, expression, scale**2 * likely, None if neutral else solver)
        offsets = _without_pose(offsets, solver.points.rest[:LANDMARKS].double(), likely)
    return offsets.rounded()


def _without_pose(offsets: LandmarkOffsets, rest: Tensor, likely: Tensor) -> LandmarkOffsets:
    """The offsets without what moves, turns or grows all landmarks (68,3) alike: that is where the head is.

    Frames cannot tell a smaller head from one that is further away, so the covariance of offsets alone would say; heads
    with small eyes and mouths are small, and the rig was drawn by up to 8 % nearer, and larger, than the face.
    """
    weights = likely.diagonal().view(-1, 3).sum(1).reciprocal()
    moved = similarity_transform(rest[None], (rest + offsets.millimetres)[None], weights[None])
    return replace(offsets, millimetres=moved.inverse().apply(rest + offsets.millimetres)[0] - rest)


def _split(
    mean: _Mean, before: LandmarkOffsets, expression: Tensor | None, likely: Tensor, solver: VideoSolver | None
) -> tuple[LandmarkOffsets, Tensor]:
    """The mean residual as offsets, of likely covariance (204,204), and a constant expression, (N,), none without a
    solver."""
    count = len(mean.weights)
    here = torch.cat([mean.weights, before.millimetres.flatten()])
    f = mean.gradient - mean.H @ here
    beside = (count, 0)
    H = mean.H + pad(torch.cholesky_inverse(torch.linalg.cholesky(likely)), 2 * beside)
    H = H + pad(torch.full_like(mean.weights, 1e-3), (0, len(likely))).diag()
    upper = pad(torch.full_like(mean.weights, float(solver is not None)), (0, len(likely)), value=_FREE)
    lower = pad(torch.zeros_like(mean.weights), (0, len(likely)), value=-_FREE)
    solution = here
    for _ in range(_REWEIGHTINGS):  # each penalty is by the weights that the one before led to
        read, falls = mean.read, 1.0 if expression is None else 1 / (1 + expression / _SOFTENING)
        penalty = pad((read is None) * _PENALTY * falls * torch.ones_like(mean.weights), (0, len(likely)))
        program = H
        if solver is not None and solver.prior is not None:
            learned = solver.prior.energy((mean.weights if expression is None else expression)[None])
            strength = _PRIOR / solver.prior.strength
            program = H + strength * pad(learned.H[0], 2 * (0, len(likely)))
            penalty = penalty + strength * pad(learned.f[0], (0, len(likely)))
        if solver is not None and read is not None:
            program = program + pad(read.H[0], 2 * (0, len(likely)))
            penalty = penalty + pad(read.f[0], (0, len(likely)))
        solution = box_qp(program, (f + penalty)[None], lower, upper)[0]
        expression = solution[:count]
    noise = min(mean.noise, before.noise)
    return replace(before, millimetres=solution[count:].view(-1, 3), noise=noise), solution[:count]


def _solved(solver: VideoSolver, take: _Take, start: HeadState) -> tuple[HeadState, FrameTerms, Tensor]:
    """The frames solved from a start, with their terms and which of the rig's points their landmarks are."""
    noise = solver.noise(start.rotation, start.translation)
    precision = (solver.landmark_weights.double() * take.trust).sqrt() / noise[:, None]
    known = take.landmarks.nan_to_num(0.0)
    information = solver.initial_information.double().diag().expand(len(known), -1, -1)
    read = None if take.read is None else take.read.energy()
    terms = FrameTerms(known, precision, start.rotation, start.translation, Expectation(start, information), read=read)
    return solver.solve(terms, start)[0], terms, noise


def _mean_problem(solver: VideoSolver, take: _Take, start: HeadState, likely: Tensor) -> tuple[HeadState, _Mean]:
    """The frames solved from a start, and what their residuals have in common where the face rests."""
    count = len(solver.names)
    head, terms, noise = _solved(solver, take, start)
    weight = solver.landmark_weights.double() * take.trust
    rows, K = solver.chosen(head), solver.intrinsics.double()
    at = linearise(solver.points, head, rows, K, terms.landmarks, terms.precision, solver.settings.contour_slide)
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
    share = 1 / (1 + size / size.median().clamp(min=1e-12)) * (1.0 if take.resting is None else take.resting)
    share = share / share.sum()
    # A residual of 1 is the frames' noise, in millimetres on the head:
    unit = float((noise * head.translation[:, 2]).median() / K[0, 0])
    factor = (unit / _MODEL_ERROR) ** 2
    shared = factor * (share[:, None, None] * left).flatten(0, 1).T
    H, gradient = shared @ by_both.flatten(0, 1), shared @ rest.flatten()
    read = None
    if terms.read is not None:
        H_read = LASTING * torch.einsum("t,tij->ij", share, terms.read.H)
        read = Quadratic(H_read[None], LASTING * (share @ terms.read.f)[None])
    mean = _Mean(
        read,
        0.5 * (H + H.T),
        gradient,
        share @ head.weights,
        _scale(share, residual, jacobian, weight, likely.diagonal().view(-1, 3).mean(1).sqrt() / unit),
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
