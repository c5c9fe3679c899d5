"""A head's pose before a camera as Live Link Face has it: yaw, pitch and roll."""

import torch
from torch import Tensor

from torchface.capture.own_rig.eye_geometry import LOOKS, gaze_of_looks
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.take import Track


def head_angles(rotation: Tensor) -> Tensor:
    r"""Yaw, pitch and roll (...,3), radians, of rotations from the rig to an OpenCV camera (...,3,3); NaN stays NaN.

    .. math:: \mathrm{diag}(1,-1,-1) \, R = R_y(\text{yaw}) \, R_x(\text{pitch}) \, R_z(\text{roll})

    Zero is a face that looks straight into the lens. Positive yaw rotates it to the viewer's right, positive pitch
    nods it down, positive roll tilts it counter-clockwise as the viewer sees it.
    """
    upright = rotation * rotation.new_tensor([1.0, -1.0, -1.0])[:, None]
    yaw = torch.atan2(upright[..., 0, 2], upright[..., 2, 2])
    pitch = torch.asin((-upright[..., 1, 2]).clamp(-1, 1))
    roll = torch.atan2(upright[..., 1, 0], upright[..., 1, 1])
    return torch.stack([yaw, pitch, roll], dim=-1)


def head_rotations(angles: Tensor) -> Tensor:
    """The rotations (...,3,3) whose :func:`head_angles` are yaw, pitch and roll (...,3)."""
    (yaw, pitch, roll), one = angles.unbind(-1), torch.ones_like(angles[..., 0])
    zero, signs = torch.zeros_like(one), angles.new_tensor([1.0, -1.0, -1.0])[:, None]

    def matrix(*rows: Tensor) -> Tensor:
        return torch.stack(rows, -1).unflatten(-1, (3, 3))

    about_y = matrix(yaw.cos(), zero, yaw.sin(), zero, one, zero, -yaw.sin(), zero, yaw.cos())
    about_x = matrix(one, zero, zero, zero, pitch.cos(), -pitch.sin(), zero, pitch.sin(), pitch.cos())
    about_z = matrix(roll.cos(), -roll.sin(), zero, roll.sin(), roll.cos(), zero, zero, zero, one)
    return signs * (about_y @ about_x @ about_z)


def eye_angles(gaze: Tensor) -> Tensor:
    """Yaw, pitch and roll of the left eye, then of the right, (...,6), as Live Link Face has them.

    Positive yaw looks to the person's right, positive pitch down; eyes do not roll.

    Args:
        gaze: right eye first, to the person's left and up, (...,2,2) radians.
    """
    still = gaze.new_zeros(*gaze.shape[:-1], 1)
    return torch.cat([-gaze.flip(-2), still], -1).flatten(-2)


def still_head_columns(weights: Track, turns: Tensor) -> dict[str, Tensor]:
    """Live Link Face's nine columns of a head that does not turn, whose eyes look where weights (T,52) of ARKit say.

    Args:
        turns: by what each shape of ``LOOKS`` turns its eye at weight 1, (8,) radians; see :class:`Eyeballs`.
    """
    looks = weights.select(LOOKS).values[..., 0].double()
    ahead = torch.tensor([1.0, -1.0, -1.0]).diag().expand(len(weights), 3, 3)
    return rotation_columns(ahead, gaze_of_looks(looks, turns).nan_to_num(0.0))


def rotation_columns(rotation: Tensor, gaze: Tensor) -> dict[str, Tensor]:
    """Live Link Face's nine columns by name, each (T,) float64: the head's of rotations (T,3,3), the eyes' of gaze."""
    head, eyes = head_angles(rotation.detach().cpu().double()), eye_angles(gaze.detach().cpu().double())
    return dict(zip(ROTATIONS, torch.cat([head, eyes], 1).unbind(1), strict=True))
