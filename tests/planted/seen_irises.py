"""Irises of a rig's eyeballs as a camera sees them."""

import torch
from torch import Tensor

from torchface.capture.own_rig.eye_geometry import CORNERS, Eyeballs
from torchface.rig import BlendshapeRig


def irises(rig: BlendshapeRig, gaze: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """Where a camera of focal length 1 sees the irises of eyes with a gaze (T,2,2), (T,2,2)."""
    eyes, marks = Eyeballs.of(rig), rig.vertices[rig.neutral.landmarks].double()
    middle = torch.stack([0.5 * (marks[a] + marks[b]) for a, b in CORNERS]) + eyes.centre
    side, up = gaze[..., 0], gaze[..., 1]
    sight = torch.stack([side.sin() * up.cos(), up.sin(), side.cos() * up.cos()], -1)
    placed = (middle + eyes.radius[:, None] * sight) @ rotation.mT + translation[:, None]
    return placed[..., :2] / placed[..., 2:]
