"""A planted similarity comes back, and never as a reflection."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from torchface.errors import AlignmentError, ShapeError, ValueRangeError
from torchface.geometry.similarity import similarity_transform


def planted(batch: int = 4, count: int = 20) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(batch, count, 3, generator=generator, dtype=torch.float64) * 50
    rotation = torch.from_numpy(Rotation.random(batch, random_state=0).as_matrix())
    scale = torch.rand(batch, generator=generator, dtype=torch.float64) + 0.5
    translation = torch.randn(batch, 3, generator=generator, dtype=torch.float64) * 100
    return points, rotation, scale, translation


def test_planted_similarity_is_recovered_with_missing_points() -> None:
    points, rotation, scale, translation = planted()
    target = scale[:, None, None] * points @ rotation.transpose(1, 2) + translation[:, None]
    target[:, ::4] = torch.nan
    found = similarity_transform(points, target)
    torch.testing.assert_close(found.rotation, rotation)
    torch.testing.assert_close(found.scale, scale)
    torch.testing.assert_close(found.translation, translation)
    torch.testing.assert_close(found.inverse().apply(found.apply(points)), points)


def test_agrees_with_scipy_where_noise_leaves_a_residual() -> None:
    points, rotation, _, _ = planted(1)
    noisy = points[0] @ rotation[0].T + torch.randn(20, 3, generator=torch.Generator().manual_seed(1)).double() * 5
    weights = torch.rand(20, generator=torch.Generator().manual_seed(2)).double()
    found = similarity_transform(points, noisy[None], weights[None], scale=False)
    x = points[0] - (weights[:, None] * points[0]).sum(0) / weights.sum()
    y = noisy - (weights[:, None] * noisy).sum(0) / weights.sum()
    expected, _ = Rotation.align_vectors(y.numpy(), x.numpy(), weights=weights.numpy())
    torch.testing.assert_close(found.rotation[0], torch.from_numpy(expected.as_matrix()))
    assert float(found.scale[0]) == 1.0


def test_whole_numbers_count_as_they_are() -> None:
    points = planted(1)[0].round()
    found = similarity_transform(points.long(), 1.5 * points + 0.5)
    torch.testing.assert_close(found.rotation[0], torch.eye(3), rtol=0, atol=1e-6)
    for apply, shift in ((found.apply, 0.5), (found.apply_vectors, 0.0)):
        torch.testing.assert_close(apply(points.long()).double(), 1.5 * points + shift, rtol=0, atol=1e-3)


def test_mirrored_points_give_a_rotation() -> None:
    points, *_ = planted(1)
    found = similarity_transform(points, points * torch.tensor([-1.0, 1, 1]).double())
    torch.testing.assert_close(torch.linalg.det(found.rotation), torch.ones(1).double())


def test_two_points_are_too_few() -> None:
    points = torch.full((1, 5, 3), torch.nan)
    points[:, :2] = 1.0
    with pytest.raises(ShapeError, match="2 points present, expected at least 3"):
        similarity_transform(points, torch.zeros(1, 5, 3))


def test_no_sets_give_no_similarities() -> None:
    none = torch.zeros(0, 4, 3)
    assert similarity_transform(none, none).apply(none).shape == (0, 4, 3)


def test_points_that_coincide_have_no_scale() -> None:
    """Without a scale nothing is undetermined but the rotation."""
    points, *_ = planted(2)
    same = points.clone()
    same[1] = 7.3
    for source, target in ((same, points), (points, same)):
        with pytest.raises(AlignmentError, match=r"coincide in rows \[1\]"):
            similarity_transform(source, target)
        found = similarity_transform(source, target, scale=False)
        torch.testing.assert_close(found.apply(source).mean(1), target.mean(1))


@pytest.mark.parametrize("weight", [-1.0, torch.nan, torch.inf])
def test_weights_are_finite_and_not_negative(weight: float) -> None:
    points, *_ = planted(1, 5)
    with pytest.raises(ValueRangeError, match="weights: found a negative, infinite or NaN one"):
        similarity_transform(points, points, torch.tensor([[1.0, 1, 1, 1, weight]]))
