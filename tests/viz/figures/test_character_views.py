"""Sheets of a character's face show the whole head from both sides."""

import torch
import trimesh

from torchface.viz.figures.character_views import character_sheet
from torchface.workflows.rig.character_face import plain_surface
from torchface.workflows.rig.character_job import FACE_SPAN


def test_a_turned_head_is_in_the_middle_of_its_view() -> None:
    ball = trimesh.creation.icosphere(3)
    vertices = torch.from_numpy(ball.vertices) * torch.tensor([80.0, 115.0, 95.0], dtype=torch.float64)
    face = torch.tensor([0.0, -20.0, 75.0], dtype=torch.float64)  # the mean of a head's landmarks lies so far in front
    side = 60
    drawn = character_sheet(plain_surface(vertices, torch.from_numpy(ball.faces)), {}, face, FACE_SPAN, side)
    turned = drawn[:, -side:, :side]
    across = ((turned - turned[:, :1, :1]).abs().amax((0, 1)) > 0.02).nonzero()[:, 0]
    left, right = int(across[0]), side - 1 - int(across[-1])
    assert min(left, right) > side // 12
    assert abs(left - right) < side // 6
