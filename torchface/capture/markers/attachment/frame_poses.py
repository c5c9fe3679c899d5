"""How a take lies in a rig's space: by one similarity, or where the helmet slips by one scale and a motion a frame."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.capture.markers.helmet_solver import rigid_columns, rigid_turn
from torchface.capture.markers.rest_pose import pose_step, solve_weights
from torchface.geometry.similarity import Similarity, similarity_transform

# A frame with fewer markers tells no motion beside weights.
LEAST_SEEN = 6


def frame_poses(paths: Tensor, target: Tensor, scale: Tensor) -> Similarity:
    """Rigid motions after one scale that lay each frame's markers (T,M,3) on points (T,M,3): (T,) similarities."""
    rigid = similarity_transform(scale * paths, target, scale=False)
    return Similarity(scale.expand(len(paths)), rigid.rotation, rigid.translation)


def solve_frames(
    affine: Tensor, paths: Tensor, pose: Similarity, ridge: float, start: Tensor | None
) -> tuple[Tensor, Similarity]:
    """Weights of all frames; where every frame has a pose of its own, its motion together with them.

    Args:
        affine: of the sites, (M,3,N+1), millimetres.
        paths: markers (T,M,3), NaN for not seen.
        pose: (1,) or (T,).
        ridge, start: as in ``solve_weights``.

    Returns:
        Weights (T,N) and the pose.
    """
    moved = pose.apply(paths)
    if len(pose.scale) == 1:
        return solve_weights(affine, moved, ridge, start), pose
    rest = affine[..., 0]
    pivot = rest.mean(0)
    columns = rigid_columns(rest, pivot)
    if start is not None:
        start = torch.cat([start, start.new_zeros(len(start), columns.shape[2])], dim=1)
    solved = solve_weights(torch.cat([affine, columns], dim=2), moved, ridge, start, unbounded=columns.shape[2])
    weights, motion = solved.split([affine.shape[2] - 1, columns.shape[2]], dim=1)
    return weights, without_motion(pose, motion, pivot)


def without_motion(pose: Similarity, motion: Tensor, pivot: Tensor) -> Similarity:
    """Poses (T,) freed of a rigid motion (T,6), in the columns of ``rigid_columns``, of what they deliver."""
    back = rigid_turn(motion[:, 3:]).transpose(1, 2)
    centred = pose.translation - motion[:, :3] - pivot
    return Similarity(pose.scale, back @ pose.rotation, (back @ centred[..., None])[..., 0] + pivot)


def better_pose(
    paths: Tensor, pose: Similarity, on_rig: Tensor, outward: Tensor | None = None
) -> tuple[Similarity, float]:
    """``pose_step`` for one pose; of poses a frame only the scale, each about its frame's mean, and the stand-off."""
    if len(pose.scale) == 1:
        return pose_step(paths, pose, on_rig, outward)
    moved = pose.apply(paths)
    gone = torch.isnan(moved)
    centre = moved.nanmean(1, keepdim=True)
    arm = (moved - centre).nan_to_num(0.0)
    left = torch.where(gone, 0.0, on_rig - moved)
    rows = arm.flatten()[None]
    if outward is not None:
        rows = torch.cat([rows, torch.where(gone, 0.0, -outward).flatten()[None]])
    step = torch.linalg.solve(rows @ rows.T, rows @ left.flatten())
    return scaled(pose, 1 + step[0], centre[:, 0]), float(step[1]) if outward is not None else 0.0


def scaled(pose: Similarity, grow: Tensor, centre: Tensor) -> Similarity:
    """Poses (T,) after which all grows about a centre (T,3)."""
    return Similarity(pose.scale * grow, pose.rotation, centre + grow * (pose.translation - centre))
