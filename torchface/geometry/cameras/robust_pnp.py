"""Poses of a camera from points of which some are outliers."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.pnp import Pose, refined_poses
from torchface.geometry.rotations import rotation_matrix

_MIN_POINTS = 4
_REFINEMENTS = 3
_MIN_DEPTH = 1e-3
# Where two temples are 12 pixels off, poses jump by 15 degrees with 300 draws at 0.99, and by 2.8 with these and the
# weights (tests/benchmarks/test_head_pose.py).
_DRAWS, _CONFIDENCE = 4000, 1 - 1e-9


@dataclass(frozen=True, eq=False)
class RobustPose:
    """World to camera for a batch, and the points that agree with it."""

    pose: Pose  # rotations (B,3,3), translations (B,3), errors (B,) over the inliers; NaN where none was found
    inliers: Tensor  # points that are seen where the pose has them, (B,N) bool

    @property
    def found(self) -> Tensor:
        """Frames with a pose, (B,) bool."""
        return torch.isfinite(self.pose.errors)


def robust_pnp(
    points: Tensor, pixels: Tensor, intrinsics: Tensor, threshold: float | Tensor = 4.0, weights: Tensor | None = None
) -> RobustPose:
    r"""The poses in which a camera sees most points where they are seen.

    .. math:: \min_{R,t} \sum_i \min\big( w_i \lVert \pi(K (R x_i + t)) - q_i \rVert^2, \tau^2 \big)

    OpenCV's RANSAC with AP3P gives a pose of each frame by itself. All are refined at once on their inliers by
    Levenberg's method, and the inliers chosen anew by weight until they stay the same.

    Args:
        points: x, (N,3), millimetres.
        pixels: q, (B,N,2); a NaN row counts as not seen.
        intrinsics: K, (3,3).
        threshold: :math:`\tau`, pixels, one for all or (B,); three deviations of good landmarks or so.
        weights: w, non-negative, (B,N) or (N,); 1 if absent. Where points are not equally exact, inverse variances in
            units of the others': a point of weight 1/4 may have twice the residual. One of weight 0 is never an inlier.

    Returns:
        ``RobustPose(pose, inliers (B,N))`` in float64. Frames with fewer than four points seen, or four that agree,
        have no pose: NaN.

    Source: Ke and Roumeliotis 2017 (AP3P); Fischler and Bolles 1981; thesis 4.2.4.
    """
    x, q, K, w = _checked(points, pixels, intrinsics, weights)
    limit = _limits(threshold, q)
    rotation, translation, inliers = _first_poses(x, q, K, w, limit)
    before = torch.zeros_like(inliers)
    for _ in range(_REFINEMENTS):
        going = ((inliers.sum(1) >= _MIN_POINTS) & (inliers != before).any(1)).nonzero()[:, 0]
        if not len(going):
            break
        used = torch.where(inliers[going], w[going], 0.0)
        seen = torch.where((used > 0)[..., None], x, 0.0)
        pose = refined_poses(seen, q[going], K.expand(len(going), 3, 3), used, rotation[going], translation[going])
        rotation[going], translation[going], before = pose.rotation, pose.translation, inliers
        agreed = _squared(x, q, K, rotation, translation) * w < limit[:, None].square()
        inliers = agreed & (w > 0)
    found = inliers.sum(1) >= _MIN_POINTS
    inliers &= found[:, None]
    squared = _squared(x, q, K, rotation, translation) * w
    error = (torch.where(inliers, squared, 0.0).sum(1) / torch.where(inliers, w, 0.0).sum(1)).sqrt()
    rotation[~found], translation[~found], error[~found] = torch.nan, torch.nan, torch.nan
    return RobustPose(Pose(rotation, translation, error), inliers)


def _first_poses(x: Tensor, q: Tensor, K: Tensor, w: Tensor, limit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations (B,3,3), translations (B,3), NaN where there is none, and inliers (B,N) by RANSAC, view by view."""
    import cv2  # loads in 0.1 s

    turns, moves = x.new_full((len(q), 3), torch.nan, device="cpu"), x.new_full((len(q), 3), torch.nan, device="cpu")
    model, views, camera, used = x.cpu().numpy(), q.cpu().numpy(), K.cpu().numpy(), (w > 0).cpu().numpy()
    thresholds = (limit / w.amax(1).clamp(min=1e-12).sqrt()).tolist()
    inliers = torch.zeros(used.shape, dtype=torch.bool)
    for row in (used.sum(1) >= _MIN_POINTS).nonzero()[0]:
        good, turn, move, agreed = cv2.solvePnPRansac(
            model[used[row]],
            views[row, used[row]],
            camera,
            None,
            iterationsCount=_DRAWS,
            reprojectionError=thresholds[row],
            confidence=_CONFIDENCE,
            flags=cv2.SOLVEPNP_AP3P,
        )
        if good and agreed is not None:
            turns[row], moves[row] = torch.from_numpy(turn[:, 0]), torch.from_numpy(move[:, 0])
            inliers[row, used[row].nonzero()[0][agreed[:, 0]]] = True
    return rotation_matrix(turns.to(x.device)), moves.to(x.device), inliers.to(x.device)


def _squared(x: Tensor, q: Tensor, K: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """Squared errors (B,N), pixels; infinite behind the camera and where the pose is NaN."""
    image = (x @ rotation.transpose(-1, -2) + translation[:, None]) @ K.T
    near = _MIN_DEPTH * (x - x.mean(0)).norm(dim=-1).amax()
    squared = (image[..., :2] / image[..., 2:] - q).square().sum(-1)
    return torch.where(image[..., 2] > near, squared, torch.inf)


def _limits(threshold: float | Tensor, q: Tensor) -> Tensor:
    limit, frames = torch.as_tensor(threshold, dtype=q.dtype, device=q.device).detach(), len(q)
    if limit.shape not in ((), (frames,)):
        raise ShapeError(f"threshold: found {tuple(limit.shape)}, expected one number or ({frames},)")
    if not ((limit > 0) & limit.isfinite()).all():
        raise ValueRangeError(f"robust_pnp: found threshold {threshold}, expected positive numbers")
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
