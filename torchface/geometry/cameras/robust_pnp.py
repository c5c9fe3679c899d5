"""Where a camera stands, from points some of which it sees where they are not."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.pnp import Pose, refined_poses
from torchface.geometry.cameras.three_points import three_point_poses

_MIN_POINTS = 4
_CANDIDATES = 3  # hypotheses of a frame that are refined; the best one before it need not be the best after
_REFINEMENTS = 3
_MIN_AGREEMENT = 0.75  # share of the points seen that agree with an initial guess that needs no rival
_MIN_DEPTH = 1e-3
_MAX_NUMBERS = 2**20  # numbers held at once for a chunk of frames


@dataclass(frozen=True, eq=False)
class RobustPose:
    """World to camera for a batch, and what it rests on.

    Args:
        pose: rotations (B,3,3), translations (B,3), errors (B,) over the inliers; NaN where none was found.
        inliers: points that are seen where the pose has them, (B,N) bool.
    """

    pose: Pose
    inliers: Tensor

    @property
    def found(self) -> Tensor:
        """Frames with a pose, (B,) bool."""
        return torch.isfinite(self.pose.errors)


def robust_pnp(
    points: Tensor,
    pixels: Tensor,
    intrinsics: Tensor,
    threshold: float | Tensor = 4.0,
    weights: Tensor | None = None,
    initial: Pose | None = None,
    hypotheses: int = 128,
    seed: int = 0,
) -> RobustPose:
    r"""The poses in which a camera sees most points where they are seen, whatever the outliers do.

    .. math:: \min_{R,t} \sum_i \min\big( w_i \lVert \pi(K (R x_i + t)) - q_i \rVert^2, \tau^2 \big)

    Random triples of points give hypotheses (RANSAC, scored by the sum above); the best few are refined on their
    inliers by Levenberg's method, and the inliers chosen anew until they stay the same. All frames and hypotheses at
    once; every frame draws the same triples, so that its answer does not depend on the others.

    Args:
        points: x, (N,3), millimetres.
        pixels: q, (B,N,2); a NaN row counts as not seen.
        intrinsics: K, (3,3).
        threshold: :math:`\tau`, pixels, one for all or (B,); three deviations of good landmarks or so.
        weights: w, non-negative, (B,N) or (N,); 1 if absent. Where points are not equally exact, inverse variances in
            units of the others': a point of weight 1/4 may have twice the residual. One of weight 0 is never an inlier.
        initial: initial guesses, such as the poses of the frames before; NaN where there is none. Where three
            quarters of the points seen agree with it, nothing is drawn.
        hypotheses: triples drawn a frame; 128 find a good one nearly always while half of the points are wrong.
        seed: of the draws.

    Returns:
        ``RobustPose(pose, inliers (B,N))`` in float64. Frames with fewer than four points seen, or four that agree,
        have no pose: NaN.

    Raises:
        ShapeError: the shapes do not fit each other.
        ValueRangeError: the threshold or the number of hypotheses is not positive, or a point or weight not finite.

    Source: Fischler and Bolles 1981; Torr and Zisserman 2000; thesis 4.2.4.
    """
    x, q, K, w = _checked(points, pixels, intrinsics, weights)
    limit = _limits(threshold, q, hypotheses)
    guess = _guesses(initial, q)
    size = max(1, _MAX_NUMBERS // (hypotheses * 4 * len(x)))
    before = _squared(x, q, K, guess[:, None, :, :3], guess[:, None, :, 3])[:, 0]
    close = (before * w < limit[:, None].square()) & (w > 0)
    sure = close.sum(1) >= _MIN_AGREEMENT * (w > 0).sum(1)
    found = RobustPose(Pose(*(guess.new_full(shape, torch.nan) for shape in _shapes(len(q)))), close)
    for draws, frames in ((0, sure.nonzero()[:, 0]), (hypotheses, (~sure).nonzero()[:, 0])):
        # Drawn on the CPU, so that every device draws the same.
        order = torch.rand(draws, len(x), generator=torch.Generator().manual_seed(seed), device="cpu").to(x.device)
        for part in frames.split(size) if len(frames) else ():
            pose, inliers = _consensus(x, q[part], K, w[part], guess[part], order, limit[part])
            found.pose.rotation[part], found.pose.translation[part] = pose.rotation, pose.translation
            found.pose.errors[part], found.inliers[part] = pose.errors, inliers
    return found


def _shapes(frames: int) -> tuple[tuple[int, ...], ...]:
    return (frames, 3, 3), (frames, 3), (frames,)


def _consensus(
    x: Tensor, q: Tensor, K: Tensor, w: Tensor, guess: Tensor, order: Tensor, limit: Tensor
) -> tuple[Pose, Tensor]:
    """Poses and inliers of a chunk of frames; ``guess`` holds [R|t] to try beside."""
    enough = ((w > 0).sum(1) >= _MIN_POINTS).nonzero()[:, 0]
    rotation, translation, errors = (q.new_full(shape, torch.nan) for shape in _shapes(len(q)))
    inliers = torch.zeros_like(w, dtype=torch.bool)
    if not len(enough):
        return Pose(rotation, translation, errors), inliers
    q, w, limit = q[enough], w[enough], limit[enough]
    rotations, translations = _hypotheses(x, q, K, w, order)
    rotations = torch.cat([rotations, guess[enough, None, :, :3]], dim=1)
    translations = torch.cat([translations, guess[enough, None, :, 3]], dim=1)
    row = torch.arange(len(q), device=q.device)[:, None]
    if rotations.shape[1] > _CANDIDATES:
        # Single precision is enough to choose which are worth more work.
        rough = _scores(
            x.float(), q.float(), K.float(), w.float(), rotations.float(), translations.float(), limit.float()
        )
        kept = rough.topk(_CANDIDATES, dim=1, largest=False).indices
        rotations, translations = rotations[row, kept], translations[row, kept]
    rotations, translations = _refined(x, q, K, w, rotations, translations, limit)
    best = _scores(x, q, K, w, rotations, translations, limit).argmin(1)
    rotations, translations = rotations[row[:, 0], best], translations[row[:, 0], best]
    squared = _squared(x, q, K, rotations[:, None], translations[:, None])[:, 0]
    agreed = (squared * w < limit[:, None].square()) & (w > 0)
    found = agreed.sum(1) >= _MIN_POINTS
    weight = torch.where(agreed, w, 0.0)
    error = (torch.where(agreed, squared * w, 0.0).sum(1) / weight.sum(1)).sqrt()
    rotation[enough] = torch.where(found[:, None, None], rotations, torch.nan)
    translation[enough] = torch.where(found[:, None], translations, torch.nan)
    errors[enough] = torch.where(found, error, torch.nan)
    inliers[enough] = agreed & found[:, None]
    return Pose(rotation, translation, errors), inliers


def _hypotheses(x: Tensor, q: Tensor, K: Tensor, w: Tensor, order: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (B,4S,3,3) and translations (B,4S,3) from S triples of points."""
    if not len(order):
        return q.new_zeros(len(q), 0, 3, 3), q.new_zeros(len(q), 0, 3)
    keys = torch.where((w > 0)[:, None], order, 2.0)
    drawn = keys.topk(3, dim=-1, largest=False).indices
    rays = torch.nn.functional.pad(q, (0, 1), value=1.0) @ torch.linalg.inv(K).T
    frame = torch.arange(len(q), device=q.device)[:, None, None]
    rotation, translation = three_point_poses(x[drawn], rays[frame, drawn])
    return rotation.flatten(1, 2), translation.flatten(1, 2)


def _refined(
    x: Tensor, q: Tensor, K: Tensor, w: Tensor, rotation: Tensor, translation: Tensor, limit: Tensor
) -> tuple[Tensor, Tensor]:
    """Poses (B,H) after least squares on their own inliers, chosen anew a few times."""
    shape = rotation.shape[:2]
    rotation, translation = rotation.clone(), translation.clone()
    before = torch.zeros(*shape, len(x), dtype=torch.bool, device=x.device)
    for _ in range(_REFINEMENTS):
        squared = _squared(x, q, K, rotation, translation)
        agreed = (squared * w[:, None] < limit[:, None, None].square()) & (w > 0)[:, None]
        going = ((agreed.sum(-1) >= _MIN_POINTS) & (agreed != before).any(-1)).nonzero(as_tuple=True)
        if not len(going[0]):
            break
        frame = going[0]
        used = torch.where(agreed[going], w[frame], 0.0)
        points = torch.where((used > 0)[..., None], x, 0.0)
        pose = refined_poses(points, q[frame], K.expand(len(frame), 3, 3), used, rotation[going], translation[going])
        rotation[going], translation[going] = pose.rotation, pose.translation
        before = agreed
    return rotation, translation


def _scores(x: Tensor, q: Tensor, K: Tensor, w: Tensor, rotation: Tensor, translation: Tensor, limit: Tensor) -> Tensor:
    """Truncated squared errors (B,H), summed over the points seen."""
    squared = _squared(x, q, K, rotation, translation)
    return (
        torch.minimum((squared * w[:, None]).nan_to_num(torch.inf), limit[:, None, None].square()) * (w > 0)[:, None]
    ).sum(-1)


def _squared(x: Tensor, q: Tensor, K: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """Squared errors (B,H,N), pixels; infinite behind the camera and where the pose is NaN."""
    # K [R|t] first: three products a point and hypothesis, not six.
    offset = (K @ translation[..., None])[..., 0]
    image = x @ (K @ rotation).transpose(-1, -2) + offset[..., None, :]
    depth = image[..., 2]
    near = _MIN_DEPTH * (x - x.mean(0)).norm(dim=-1).amax()
    u, v = image[..., 0] / depth - q[:, None, :, 0], image[..., 1] / depth - q[:, None, :, 1]
    return torch.where(depth > near, u * u + v * v, torch.inf).nan_to_num(torch.inf)


def _guesses(initial: Pose | None, q: Tensor) -> Tensor:
    frames = len(q)
    if initial is None:
        return q.new_full((frames, 3, 4), torch.nan)
    if initial.rotation.shape != (frames, 3, 3) or initial.translation.shape != (frames, 3):
        raise ShapeError(
            f"initial: found rotation {tuple(initial.rotation.shape)} and translation "
            f"{tuple(initial.translation.shape)}, expected ({frames},3,3) and ({frames},3)"
        )
    return torch.cat([initial.rotation.detach().double(), initial.translation.detach().double()[..., None]], dim=-1)


def _limits(threshold: float | Tensor, q: Tensor, hypotheses: int) -> Tensor:
    limit, frames = torch.as_tensor(threshold, dtype=q.dtype, device=q.device).detach(), len(q)
    if limit.shape not in ((), (frames,)):
        raise ShapeError(f"threshold: found {tuple(limit.shape)}, expected one number or ({frames},)")
    if not ((limit > 0) & limit.isfinite()).all() or hypotheses < 1:
        raise ValueRangeError(
            f"robust_pnp: found threshold {threshold} and {hypotheses} hypotheses, expected positive numbers"
        )
    return limit.expand(frames)


def _checked(
    points: Tensor, pixels: Tensor, intrinsics: Tensor, weights: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    if points.ndim != 2 or points.shape[1] != 3 or pixels.ndim != 3 or pixels.shape[1:] != (len(points), 2):
        raise ShapeError(
            f"robust_pnp: found points {tuple(points.shape)} and pixels {tuple(pixels.shape)}, "
            "expected (N,3) and (B,N,2)"
        )
    if len(points) < _MIN_POINTS:
        raise ShapeError(f"robust_pnp: found {len(points)} points, expected at least {_MIN_POINTS}")
    if intrinsics.shape != (3, 3):
        raise ShapeError(f"intrinsics: found {tuple(intrinsics.shape)}, expected (3,3)")
    q = pixels.detach().double()
    seen = torch.isfinite(q).all(-1)
    w = torch.ones_like(seen, dtype=torch.float64)
    if weights is not None:
        if weights.shape not in (seen.shape, seen.shape[1:]):
            raise ShapeError(f"weights: found {tuple(weights.shape)}, expected {tuple(seen.shape)} or ({len(points)},)")
        w = weights.detach().double().expand(seen.shape)
    if not torch.isfinite(w).all() or (w < 0).any():
        raise ValueRangeError("robust_pnp: found a negative or infinite weight, expected finite ones of at least 0")
    w = w * seen
    x = points.detach().double()
    if not torch.isfinite(x[(w > 0).any(0)]).all():
        raise ValueRangeError("robust_pnp: found NaN or infinite points, expected finite millimetres")
    return x.nan_to_num(0.0), torch.where(seen[..., None], q, 0.0), intrinsics.detach().double(), w
