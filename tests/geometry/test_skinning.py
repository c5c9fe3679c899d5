"""Tests of linear blend skinning and its inverse."""

import torch

from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.skinning import joint_transforms, skinned, unskinned


def test_a_child_goes_with_its_parent() -> None:
    """Turned a quarter about the origin, the elbow lies above it; turned by another, the hand points back."""
    positions = torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64)
    quarter = torch.tensor([[[0.0, 0, torch.pi / 2], [0, 0, torch.pi / 2]]], dtype=torch.float64)
    turns, shifts = joint_transforms(positions, [-1, 0], quarter)
    hand = skinned(torch.tensor([[2.0, 0, 0]]).double(), torch.tensor([[0.0, 1.0]]).double(), turns, shifts)
    assert torch.allclose(hand, torch.tensor([[[-1.0, 1.0, 0.0]]]).double())


def test_the_root_turns_everything_rigidly_and_weights_blend_linearly() -> None:
    generator = torch.Generator().manual_seed(0)
    positions = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    points = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(20, 3, generator=generator, dtype=torch.float64)
    weights /= weights.sum(1, keepdim=True)
    rotations = torch.zeros(1, 3, 3, dtype=torch.float64)
    rotations[0, 0] = torch.tensor([0.3, -0.2, 0.5])
    turns, shifts = joint_transforms(positions, [-1, 0, 0], rotations)
    turn = rotation_matrix(rotations[0, :1])[0]
    assert torch.allclose(skinned(points, weights, turns, shifts)[0], (points - positions[0]) @ turn.T + positions[0])
    rotations = 0.4 * torch.randn(4, 3, 3, generator=generator, dtype=torch.float64)
    turns, shifts = joint_transforms(positions, [-1, 0, 1], rotations)
    each = torch.stack([skinned(points, torch.eye(3)[[j]].expand(20, 3), turns, shifts) for j in range(3)], 2)
    assert torch.allclose(skinned(points, weights, turns, shifts), (weights[None, :, :, None] * each).sum(2))


def test_unskinning_gives_the_vertices_back() -> None:
    generator = torch.Generator().manual_seed(1)
    positions = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    points = torch.randn(5, 30, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(30, 1, generator=generator, dtype=torch.float64)
    weights = torch.cat([weights, 1 - weights], 1)
    rotations = 0.5 * torch.randn(5, 2, 3, generator=generator, dtype=torch.float64)
    where = joint_transforms(positions, [-1, 0], rotations)
    assert torch.allclose(unskinned(skinned(points, weights, *where), weights, *where), points, atol=1e-9)
