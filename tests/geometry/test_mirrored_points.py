"""Mirrored points are told from turned ones, and points in a plane from neither."""

import pytest
import torch

from torchface.geometry.mirrored_points import check_mirrored
from torchface.geometry.rotations import rotation_matrix


def points(depth: float) -> torch.Tensor:
    cloud = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return cloud * torch.tensor([50.0, 60.0, depth], dtype=torch.float64)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_negated_axis_is_a_reflection_whatever_the_pose_and_scale(axis: int) -> None:
    target = points(20.0)
    turn = rotation_matrix(torch.tensor([0.4, -1.9, 0.7], dtype=torch.float64))
    turned = 0.1 * target @ turn.T + 300
    assert not check_mirrored(turned, target).mirrored
    flipped = turned.clone()
    flipped[:, axis] *= -1
    found = check_mirrored(flipped, target)
    assert found.mirrored
    assert found.mirrored_distance < 1e-9
    assert found.distance > 15
    flipped[3] = torch.nan
    assert check_mirrored(flipped, target).mirrored


def test_what_lies_in_a_plane_or_is_too_little_decides_nothing() -> None:
    flat, few = points(0.0), points(20.0)[:3]
    for cloud in (flat, few):
        assert not check_mirrored(cloud * torch.tensor([-1.0, 1, 1]), cloud).mirrored


def test_points_that_fit_neither_way_are_not_called_mirrored() -> None:
    target = points(20.0)
    for seed in range(20):
        order = torch.randperm(20, generator=torch.Generator().manual_seed(seed))
        assert not check_mirrored(target[order], target).mirrored
