"""The two steps that find how a take lies in the rig's space: weights of all frames, then one similarity."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.capture.energy import marker_term
from torchface.capture.markers.surface_motion import with_one
from torchface.errors import AlignmentError
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.optim import BoxQP

_ON_A_LINE = 1e-2
_TOLERANCE = 3e-6
_FILLS = 12
_FREE_RIDGE = 1e-4
_FIRST_RIDGE, _LAST_RIDGE, _FALLING_ROUNDS = 3.0, 0.01, 20
_ROUNDS, _SETTLED = 80, 1e-3


def solve_weights(
    affine: Tensor, moved: Tensor, ridge: float, start: Tensor | None = None, unbounded: int = 0
) -> Tensor:
    r"""Weights for markers whose sites follow affine maps, as a step of an alternation.

    A marker that is not seen is put where the weights before had it, which keeps one H for all frames; the weights then
    come to their optimum over the steps of the alternation.

    Args:
        affine: of the sites, (M,3,N+1), millimetres of rig space.
        moved: markers in rig space, (T,M,3), NaN for not seen.
        ridge: mm² a marker for a squared weight of 1.
        start: weights of the step before, (T,N).
        unbounded: how many of the last columns are no shapes but may go any way, with hardly a ridge.

    Returns:
        Weights in [0,1], (T,N), float64; the last ``unbounded`` of any size.
    """
    basis, rest = affine[..., 1:], affine[..., 0]
    gaps = torch.isnan(moved)
    passes = 1 if not bool(gaps.any()) else _FILLS if start is None else 2
    shapes = basis.shape[-1]
    weights = moved.new_zeros(len(moved), shapes) if start is None else start
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
        solve = solve or BoxQP(energy.H + torch.diag(2 * ridges), lower, upper, _TOLERANCE)
        weights = solve(energy.f, weights)
    return weights


def pose_step(
    paths: Tensor, pose: Similarity, on_rig: Tensor, outward: Tensor | None = None
) -> tuple[Similarity, float]:
    r"""The similarity that lays a take's markers on points of the moving rig, least squares over all frames.

    .. math:: \min_{s,R,t,h} \sum_{t,m} \lVert s R y_{tm} + t - p_{tm} - h\, n_{tm} \rVert^2

    Args:
        paths: :math:`y`, (T,M,3), NaN for not seen.
        pose: where it was.
        on_rig: :math:`p`, (T,M,3).
        outward: :math:`n`, (T,M,3), where h is asked for.

    Returns:
        The similarity and h; without ``outward`` the exact one and 0, with it one Gauss-Newton step from ``pose``.
    """
    if outward is None:
        return similarity_transform(paths.reshape(1, -1, 3), on_rig.reshape(1, -1, 3)), 0.0
    moved = pose.apply(paths)
    seen = ~torch.isnan(moved[..., 0])
    y, left, n = moved[seen], (on_rig - moved)[seen], outward[seen]
    centre = y.mean(0)
    arm = y - centre
    zero = torch.zeros_like(arm[:, 0])
    x0, x1, x2 = arm.unbind(1)
    turns = [torch.stack(row, 1) for row in ((zero, -x2, x1), (x2, zero, -x0), (-x1, x0, zero))]
    axes = torch.eye(3, dtype=y.dtype)
    rows = torch.stack([*turns, *(axis.expand_as(y) for axis in axes), arm, -n], dim=1)
    matrix = torch.einsum("pic,pjc->ij", rows, rows)
    step = torch.linalg.solve(matrix, torch.einsum("pic,pc->i", rows, left))
    return nudged(pose, centre, step[:3], step[3:6], 1 + step[6]), float(step[7])


def nudged(pose: Similarity, centre: Tensor, turns: Tensor, shift: Tensor, grow: Tensor) -> Similarity:
    """One pose, then a turn (a rotation vector, (3,)) and a growth about a point (3,), then a shift (3,)."""
    skew = turns.new_zeros(3, 3)
    skew[0, 1], skew[0, 2], skew[1, 2] = -turns[2], turns[1], -turns[0]
    turn = torch.linalg.matrix_exp(skew - skew.T)
    translation = centre + grow * (turn @ (pose.translation[0] - centre)) + shift
    return Similarity(pose.scale * grow, turn @ pose.rotation, translation[None])


def pose_of_take(affine: Tensor, paths: Tensor) -> Similarity:
    """The similarity that lays a take's markers on a rig, found in turns with the weights of all frames.

    Args:
        affine: of the sites, (M,3,N+1), millimetres of rig space.
        paths: markers (T,M,3), millimetres of any space, NaN for not seen; every frame shows some.

    Returns:
        Marker space to rig space.
    """
    rest = affine[..., 0]
    pose = similarity_transform(paths.nanmean(0)[None], rest[None])
    weights, before = None, rest
    for number in range(_ROUNDS):
        falling = min(number / (_FALLING_ROUNDS - 1), 1.0)
        ridge = _FIRST_RIDGE * (_LAST_RIDGE / _FIRST_RIDGE) ** falling
        weights = solve_weights(affine, pose.apply(paths), ridge, weights)
        pose, _ = pose_step(paths, pose, torch.einsum("mcn,tn->tmc", affine, with_one(weights)))
        # How far the sites at rest went since the last round says whether the pose still moves.
        here = pose.inverse().apply(rest)[0]
        settled = float(((here - before).norm(dim=1) * pose.scale).max()) < _SETTLED
        before = here
        if settled and falling == 1.0:
            break
    return pose


def check_spread(points: Tensor) -> None:
    """Raises ``AlignmentError`` where points (M,3) lie on a line or in one spot: no rotation can be told."""
    if len(points) < 3:
        raise AlignmentError(f"markers: found {len(points)}, expected at least three")
    spread = torch.linalg.svdvals(points - points.mean(0))
    if not float(spread[1]) > _ON_A_LINE * float(spread[0]):
        raise AlignmentError(
            f"markers: found {len(points)} on a line (extent {float(spread[1]):.3g} across {float(spread[0]):.3g} "
            "along it), expected markers spread over the face"
        )
