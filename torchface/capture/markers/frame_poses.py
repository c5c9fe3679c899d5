"""The pose of a take in a rig's space: one similarity, or where the helmet slips one scale and a motion a frame."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.capture.markers.helmet_motion import rigid_columns, rigid_rotation, rough_motion
from torchface.capture.markers.rest_pose import pose_step, solve_weights
from torchface.geometry.similarity import Similarity

# A frame with fewer markers does not determine a rigid motion beside the weights.
MIN_MARKERS = 6
_MOTION_ITERATIONS = 6


def rough_poses(paths: Tensor, rest: Tensor, scale: Tensor) -> Similarity:
    """One scale and roughly the rigid motion that lays each frame's markers (T,M,3) on the sites at rest (M,3): (T,)
    similarities."""
    return replace(rough_motion(scale * paths, rest)[0].inverse(), scale=scale.expand(len(paths)))


def frame_poses(affine: Tensor, paths: Tensor, scale: Tensor, ridge: float) -> tuple[Tensor, Similarity]:
    """Weights (T,N) and one scale with a rigid motion for each frame, (T,) similarities, solved for together."""
    weights, pose = None, rough_poses(paths, affine[..., 0], scale)
    for _ in range(_MOTION_ITERATIONS):
        weights, pose = solve_frames(affine, paths, pose, ridge, weights)
    assert weights is not None
    return weights, pose


def solve_frames(
    affine: Tensor, paths: Tensor, pose: Similarity, ridge: float, initial: Tensor | None
) -> tuple[Tensor, Similarity]:
    """Weights (T,N) by sites' affine maps (M,3,N+1) and markers (T,M,3); where every frame has a pose of its own,
    that too."""
    moved = pose.apply(paths)
    if len(pose.scale) == 1:
        return solve_weights(affine, moved, ridge, initial), pose
    rest = affine[..., 0]
    pivot = rest.mean(0)
    columns = rigid_columns(rest, pivot)
    if initial is not None:
        initial = torch.cat([initial, initial.new_zeros(len(initial), columns.shape[2])], dim=1)
    solved = solve_weights(torch.cat([affine, columns], dim=2), moved, ridge, initial, unbounded=columns.shape[2])
    weights, motion = solved.split([affine.shape[2] - 1, columns.shape[2]], dim=1)
    return weights, without_motion(pose, motion, pivot)


def without_motion(pose: Similarity, motion: Tensor, pivot: Tensor) -> Similarity:
    """Poses (T,) less a rigid motion (T,6) of their output, in the columns of ``rigid_columns``."""
    inverse = rigid_rotation(motion[:, 3:]).transpose(1, 2)
    centred = pose.translation - motion[:, :3] - pivot
    return Similarity(pose.scale, inverse @ pose.rotation, (inverse @ centred[..., None])[..., 0] + pivot)


def better_pose(
    paths: Tensor, pose: Similarity, on_rig: Tensor, outward: Tensor | None = None, scale: bool = True
) -> tuple[Similarity, float]:
    """``pose_step`` for one pose; of poses a frame only the scale, each about its frame's mean, and the stand-off."""
    if len(pose.scale) == 1:
        return pose_step(paths, pose, on_rig, outward, scale)
    moved = pose.apply(paths)
    missing = torch.isnan(moved)
    centre = moved.nanmean(1, keepdim=True)
    arm = (moved - centre).nan_to_num(0.0)
    residual = torch.where(missing, 0.0, on_rig - moved)
    rows = arm.flatten()[None]
    if outward is not None:
        rows = torch.cat([rows, torch.where(missing, 0.0, -outward).flatten()[None]])
    matrix, gradient = rows @ rows.T, rows @ residual.flatten()
    if not scale:
        matrix[0], matrix[:, 0], matrix[0, 0], gradient[0] = 0.0, 0.0, 1.0, 0.0
    step = torch.linalg.solve(matrix, gradient)
    return scaled(pose, 1 + step[0], centre[:, 0]), float(step[1]) if outward is not None else 0.0


def scaled(pose: Similarity, factor: Tensor, centre: Tensor) -> Similarity:
    """Poses (T,) scaled about a centre (T,3)."""
    return Similarity(pose.scale * factor, pose.rotation, centre + factor * (pose.translation - centre))
