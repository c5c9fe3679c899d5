"""Choice of a take's frames that together tell a person's head: of several angles and expressions, and well seen."""

import math

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.modeling.photographs.landmark_view import JAW, LANDMARKS

_ANGLE = math.sin(math.radians(15.0))
_EXPRESSION = 0.03  # of the eyes' distance, root mean square: as different as a turn by 15°
_MOST_ANGLE = 60.0
_SEEN, _SHARP = 0.85, 0.5  # of the frame's trust that is seldom exceeded; how many are sharp enough
_MIN_LANDMARKS, _ROUNDS = 20, 10


def choose_frames(
    rest: Tensor, landmarks: Tensor, trust: Tensor, count: int, sharpness: Tensor | None = None
) -> Tensor:
    """Frames whose poses and expressions differ most from each other, rising, at most ``count`` of them.

    Frames are grouped by where an affine camera stands and by what its fit of a head at rest leaves over; of each group
    the one in its middle is taken, so that a frame with wrong landmarks is not.

    Args:
        rest: landmarks of a head at rest, (68,3) millimetres.
        landmarks: (T,68,2) pixels; NaN for not seen.
        trust: in each, (T,68) in [0,1].
        count: how many frames, at least one.
        sharpness: of each frame, (T,), in any unit; the sharper half of the frames is chosen from. Not regarded if
            absent.

    Example:
        >>> from torchface.geometry.cameras.pinhole import look_at
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> rest = head.vertices[head.landmarks].double()
        >>> views = [look_at(rest.mean(0), yaw).project(rest) for yaw in (0.0, 1.0, 40.0, 41.0)]
        >>> len(choose_frames(rest, torch.stack(views), torch.ones(4, 68), 2))
        2
    """
    if landmarks.shape[1:] != (LANDMARKS, 2) or trust.shape != landmarks.shape[:2] or rest.shape != (LANDMARKS, 3):
        raise ShapeError(
            f"choose_frames: found rest {tuple(rest.shape)}, landmarks {tuple(landmarks.shape)} and trust "
            f"{tuple(trust.shape)}, expected ({LANDMARKS},3), (T,{LANDMARKS},2) and (T,{LANDMARKS})"
        )
    features, angle = _features(rest.double(), landmarks.double(), trust.double())
    quality = trust[:, JAW:].double().mean(1)
    usable = features.isfinite().all(1) & ((trust[:, JAW:] > 0).sum(1) >= _MIN_LANDMARKS)
    if not bool(usable.any()):
        raise ValueRangeError(
            "found no frame that shows a face, expected one in which it is seen from within 60 degrees of the front"
        )
    near = usable & (angle < _MOST_ANGLE)
    usable = near if bool(near.any()) else usable
    usable &= quality >= _SEEN * quality[usable].quantile(0.9)
    if sharpness is not None:
        usable &= sharpness >= sharpness[usable].quantile(_SHARP)
    rows = usable.nonzero()[:, 0]
    return rows[_medoids(features[rows], quality[rows], count)].sort().values


def _features(rest: Tensor, landmarks: Tensor, trust: Tensor) -> tuple[Tensor, Tensor]:
    """Of each frame what is its own, (T,F), and how far the head is rotated from the camera, degrees (T,)."""
    x, q = rest[JAW:] - rest[JAW:].mean(0), landmarks[:, JAW:]
    weight = torch.where(q.isfinite().all(-1), trust[:, JAW:], 0.0)[..., None]
    q = q.nan_to_num(0.0)
    ones = torch.cat([x, torch.ones_like(x[:, :1])], dim=1)
    H = ones.T @ (weight * ones) + 1e-6 * torch.eye(4, dtype=torch.float64)
    affine = torch.linalg.solve(H, ones.T @ (weight * q))  # (T,4,2)
    right, down = affine[:, :3, 0], affine[:, :3, 1]
    size = 0.5 * (right.norm(dim=1) + down.norm(dim=1))
    ahead = torch.linalg.cross(*(torch.nn.functional.normalize(axis, dim=1) for axis in (right, down)))
    eyes = size * (rest[36] - rest[45]).norm()
    left = torch.where(weight > 0, q - ones @ affine, 0.0) / eyes[:, None, None]
    features = torch.cat([ahead[:, :2] / _ANGLE, left.flatten(1) / (_EXPRESSION * len(x) ** 0.5)], dim=1)
    return features, torch.rad2deg(torch.acos((-ahead[:, 2]).clamp(-1, 1)))


def _medoids(features: Tensor, quality: Tensor, count: int) -> Tensor:
    """Rows in the middle of at most ``count`` groups: the furthest from those before, then Lloyd's rounds."""
    chosen = [int(quality.argmax())]
    apart = (features - features[chosen[0]]).norm(dim=1)
    while len(chosen) < count and float(apart.max()) > 0:
        chosen.append(int(apart.argmax()))
        apart = torch.minimum(apart, (features - features[chosen[-1]]).norm(dim=1))
    centres = features[chosen]
    for _ in range(_ROUNDS):
        group = torch.cdist(features, centres).argmin(1)
        members = torch.nn.functional.one_hot(group, len(centres)).double()
        centres = (members.T @ features) / members.sum(0).clamp(min=1)[:, None]
    return torch.cdist(centres, features).argmin(1).unique()
