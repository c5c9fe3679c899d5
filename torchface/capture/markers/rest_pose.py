"""The two steps that align a take with a rig: weights of all frames, then one similarity."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.capture.energy import marker_term
from torchface.capture.markers.surface_motion import with_one
from torchface.errors import AlignmentError
from torchface.geometry.mirrored_points import check_mirrored
from torchface.geometry.rotations import cross_matrix, rotation_matrix
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.optim import BoxQP
from torchface.optim.box_checks import default_tolerance

_MIN_EXTENT_RATIO = 1e-2
_FILL_ITERATIONS = 12
_FREE_RIDGE = 1e-4
_FIRST_RIDGE, _LAST_RIDGE, _ANNEALING_ITERATIONS = 3.0, 0.01, 20
_MAX_ITERATIONS, _TOLERANCE = 80, 1e-3
# At first only samples farther from their sites than this are left out, mm; then the take's own limits count.
_FIRST_LIMIT = 30.0
_LIMIT_RATIO, _MIN_LIMIT, _MAX_LIMIT_RATIO = 5.0, 2.0, 2.0
# A marker farther from its site than this multiple of the median, and at least so many millimetres, is an outlier.
_OUTLIER_RATIO, _OUTLIER_DISTANCE, _POINT_ITERATIONS = 3.0, 4.0, 8


def solve_weights(
    affine: Tensor, moved: Tensor, ridge: float, initial: Tensor | None = None, unbounded: int = 0
) -> Tensor:
    r"""Weights (T,N) for markers (T,M,3), NaN for not seen, whose sites follow affine maps (M,3,N+1), a step of an
    alternation.

    A marker that is not seen is filled in by the previous weights, which keeps one H for all frames; the weights
    converge over the steps of the alternation. The last ``unbounded`` ones have no bounds.
    """
    basis, rest = affine[..., 1:], affine[..., 0]
    gaps = torch.isnan(moved)
    passes = 1 if not bool(gaps.any()) else _FILL_ITERATIONS if initial is None else 2
    shapes = basis.shape[-1]
    weights = moved.new_zeros(len(moved), shapes) if initial is None else initial
    lower, upper = affine.new_zeros(shapes), affine.new_ones(shapes)
    ridges = affine.new_full((shapes,), ridge)
    if unbounded:
        lower[-unbounded:], upper[-unbounded:], ridges[-unbounded:] = -torch.inf, torch.inf, _FREE_RIDGE
    solve = None
    for _ in range(passes):
        filled = moved
        if passes > 1:
            filled = torch.where(gaps, rest + torch.einsum("mcn,tn->tmc", basis, weights), moved)
        energy = marker_term(basis, rest, filled)
        solve = solve or BoxQP(energy.H + torch.diag(2 * ridges), lower, upper, default_tolerance(torch.float32))
        weights = solve(energy.f, weights)
    return weights


def pose_step(
    paths: Tensor, pose: Similarity, on_rig: Tensor, outward: Tensor | None = None, scale: bool = True
) -> tuple[Similarity, float]:
    r"""The similarity that aligns a take's markers with points of the moving rig, least squares over all frames.

    .. math:: \min_{s,R,t,h} \sum_{t,m} \lVert s R y_{tm} + t - p_{tm} - h\, n_{tm} \rVert^2

    Args:
        paths: :math:`y`, (T,M,3), NaN for not seen.
        pose: the present one.
        on_rig: :math:`p`, (T,M,3).
        outward: :math:`n`, (T,M,3), where h is asked for.
        scale: estimate s; otherwise it stays.

    Returns:
        The similarity and h; without ``outward`` the exact one and 0; with it one Gauss-Newton step from ``pose``.
    """
    if outward is None:
        found = similarity_transform(pose.scale * paths.reshape(1, -1, 3), on_rig.reshape(1, -1, 3), scale=scale)
        return replace(found, scale=pose.scale * found.scale), 0.0
    moved = pose.apply(paths)
    seen = ~torch.isnan(moved[..., 0])
    y, residual, n = moved[seen], (on_rig - moved)[seen], outward[seen]
    centre = y.mean(0)
    arm = y - centre
    axes = torch.eye(3, dtype=y.dtype, device=y.device).expand(len(y), 3, 3)
    rows = torch.cat([cross_matrix(arm), axes, arm[:, None], -n[:, None]], dim=1)
    if not scale:
        rows[:, 6] = 0.0
    matrix = torch.einsum("pic,pjc->ij", rows, rows)
    if not scale:
        matrix[6, 6] = 1.0
    step = torch.linalg.solve(matrix, torch.einsum("pic,pc->i", rows, residual))
    return transformed_pose(pose, centre, step[:3], step[3:6], 1 + step[6]), float(step[7])


def transformed_pose(
    pose: Similarity, centre: Tensor, rotation: Tensor, translation: Tensor, scale: Tensor
) -> Similarity:
    """One pose, then a rotation (as a vector, (3,)) and a scale about a point (3,), then a translation (3,)."""
    matrix = rotation_matrix(rotation)
    moved = centre + scale * (matrix @ (pose.translation[0] - centre)) + translation
    return Similarity(pose.scale * scale, matrix @ pose.rotation, moved[None])


def pose_of_take(affine: Tensor, paths: Tensor, scale: bool = True) -> Similarity:
    """The similarity that aligns a take's markers with a rig, alternating with the weights of all frames.

    Samples far from their sites, such as those of exchanged labels, are left out of both steps; the limit falls with
    the ridge, so that an expression that the weights do not follow yet is not taken for them.

    Args:
        affine: of the sites, (M,3,N+1), millimetres of rig space.
        paths: markers (T,M,3), millimetres of any space, NaN for not seen; every frame shows some.
    """
    rest = affine[..., 0]
    pose = pose_of_points(paths.nanmedian(0).values, rest, scale)
    weights, before = None, rest
    inlier = torch.ones_like(paths[..., :1], dtype=torch.bool)
    for number in range(_MAX_ITERATIONS):
        annealed = min(number / (_ANNEALING_ITERATIONS - 1), 1.0)
        ridge = _FIRST_RIDGE * (_LAST_RIDGE / _FIRST_RIDGE) ** annealed
        moved = pose.apply(paths)
        weights = solve_weights(affine, torch.where(inlier, moved, torch.nan), ridge, weights)
        on_rig = torch.einsum("mcn,tn->tmc", affine, with_one(weights))
        distance = (moved - on_rig).norm(dim=-1)
        limit = sample_limits(distance).clamp(min=_FIRST_LIMIT * (1 - annealed))
        inlier = (distance <= limit)[..., None]
        pose, _ = pose_step(torch.where(inlier, paths, torch.nan), pose, on_rig, scale=scale)
        # Converged where the sites at rest stay.
        sites = pose.inverse().apply(rest)[0]
        converged = float(((sites - before).norm(dim=1) * pose.scale).max()) < _TOLERANCE
        before = sites
        if converged and annealed == 1.0:
            break
    return pose


def pose_of_points(points: Tensor, target: Tensor, scale: bool = True) -> Similarity:
    """The similarity of markers (M,3) to points (M,3), over the inliers among them; NaN for not seen."""
    inlier = torch.ones(len(target), dtype=torch.bool)
    for _ in range(_POINT_ITERATIONS):
        pose = similarity_transform(points[None], target[None], inlier[None].double(), scale)
        inlier = inlier_markers((pose.apply(points)[0] - target).norm(dim=1))
    return pose


def inlier_markers(error: Tensor) -> Tensor:
    """Which markers (M,) sit on the skin, by their root mean square distance to their sites (M,), millimetres."""
    return error <= max(_OUTLIER_RATIO * float(error.nanmedian()), _OUTLIER_DISTANCE)


def sample_limits(distance: Tensor) -> Tensor:
    """The distance beyond which a sample of each marker is an outlier, (M,): five times its median, at least 2 mm.

    The distances (T,M) are NaN for what does not count.
    """
    own = (_LIMIT_RATIO * distance.nanmedian(0).values.nan_to_num(0.0)).clamp(min=_MIN_LIMIT)
    # A marker that is an outlier much of the time must not set its own limit.
    return torch.minimum(own, _MAX_LIMIT_RATIO * own.median())


def check_not_mirrored(paths: Tensor, rest: Tensor, name: str, flipped: str | None) -> None:
    """Raises ``AlignmentError`` where the mirror image of a take's median fits the sites (M,3) clearly better.

    ``flipped`` is the axis whose coordinates were negated already, if any.
    """
    found = check_mirrored(paths.nanmedian(0).values, rest)
    if found.mirrored:
        cause = (
            "the coordinates are left-handed, or the labels of left and right are swapped: export with right-handed "
            "axes or negate one axis (--flip x of torchface solve and attach; with --align any axis will do)"
            if flipped is None
            else f"the coordinates were right-handed before --flip {flipped}, or the labels of left and right are "
            f"swapped: leave out --flip {flipped}"
        )
        raise AlignmentError(
            f"{name}: the markers are a mirror image of their sites: {found.figures()} are left; {cause}, or rename "
            "the labels (--labels)"
        )


def check_not_collinear(points: Tensor, name: str = "markers") -> None:
    """Raises ``AlignmentError`` where points (M,3) lie on a line or in one spot: no rotation is determined."""
    if len(points) < 3:
        raise AlignmentError(f"{name}: found {len(points)} markers, expected at least three")
    extent = torch.linalg.svdvals(points - points.mean(0))
    if not float(extent[1]) > _MIN_EXTENT_RATIO * float(extent[0]):
        raise AlignmentError(
            f"{name}: found {len(points)} markers on a line (extent {float(extent[1]):.3g} across "
            f"{float(extent[0]):.3g} along it), expected markers spread over the face"
        )
