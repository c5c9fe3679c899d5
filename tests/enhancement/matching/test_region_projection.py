"""Projections are the nearest points of convex hulls, region by region."""

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from torchface.enhancement.matching.region_projection import RegionProjection
from torchface.errors import ShapeError

UNITS = np.sqrt([2, 2, 2, 1, 2, 2, 1, 2, 1])


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def features() -> torch.Tensor:
    """Of 20 frames and 12 patches."""
    return 0.1 * _random(20, 12, 9)


@pytest.fixture(scope="module")
def patch_weights() -> torch.Tensor:
    """Of two regions that overlap in four patches."""
    weights = torch.zeros(2, 12)
    weights[0, :8], weights[1, 4:] = 1 / 8, torch.linspace(0.05, 0.2, 8)
    return weights


def test_weights_are_those_of_nonnegative_least_squares(features, patch_weights):
    asked = 0.1 * _random(5, 12, 9, seed=1)
    found = RegionProjection(features, patch_weights, ridge=0.0).project(asked)
    assert torch.allclose(found.weights.sum(2), torch.ones(5, 2), atol=1e-5)
    for region in range(2):
        root = patch_weights[region].sqrt().numpy()[:, None] * UNITS
        known, rows = ((x.numpy() * root).reshape(len(x), -1) for x in (features, asked))
        for frame in range(5):
            # A heavy row asks for a sum of one.
            weights = nnls(np.vstack([known.T, 1e3 * np.ones(20)]), np.append(rows[frame], 1e3))[0]
            np.testing.assert_allclose(found.weights[frame, region].numpy(), weights, atol=2e-4)
            left = np.linalg.norm(weights @ known - rows[frame])
            spread = np.sqrt(np.square(known - known.mean(0)).sum(1).mean())
            assert float(found.distances[frame, region]) == pytest.approx(left / spread, rel=1e-3)


def test_a_frame_of_the_database_is_itself(features, patch_weights):
    found = RegionProjection(features, patch_weights, ridge=0.0).project(features)
    assert torch.allclose(found.weights, torch.eye(20)[:, None].expand(-1, 2, -1), atol=1e-4)
    assert float(found.distances.max()) < 1e-3


def test_excess_is_how_much_further_a_frame_goes_than_all_of_the_database(patch_weights) -> None:
    """Along one motion, ten frames go as far as 1; a region that does not move has none."""
    motion, mean = _random(12, 9, seed=3), torch.linspace(0, 1, 10).mean()
    motion[8:] = 0.0  # the second region's own patches
    weights = torch.stack([patch_weights[0], patch_weights[1] * (torch.arange(12) >= 8)])
    projection = RegionProjection(torch.linspace(0, 1, 10)[:, None, None] * motion, weights)
    amounts = torch.tensor([0.6, 1.0, 1.2, 2.0, -0.3])
    found = projection.project(amounts[:, None, None] * motion).excess
    further = (amounts - mean).abs() - mean  # from the mean, the database reaches as far as the mean on either side
    spread = (torch.linspace(0, 1, 10) - mean).square().mean().sqrt()
    torch.testing.assert_close(found[:, 0], further / spread, atol=1e-4, rtol=0)
    assert (found[:, 1] == 0).all()


def test_what_a_region_does_not_see_does_not_matter(features, patch_weights):
    other = features.clone()
    other[:, 8:] = 5.0
    projection = RegionProjection(features, patch_weights)
    assert torch.equal(projection.project(features).weights[:, 0], projection.project(other).weights[:, 0])


def test_equal_frames_share_the_weight(features, patch_weights):
    twice = torch.cat([features, features[:1] + 1e-7])
    weights = RegionProjection(twice, patch_weights).project(features[:1]).weights
    assert torch.allclose(weights[0, :, 0], weights[0, :, 20], atol=1e-2)
    assert float(weights[0, :, [0, 20]].sum(1).min()) > 0.98


def test_damping_holds_on_to_the_frame_before(features, patch_weights):
    asked = 0.1 * _random(4, 12, 9, seed=2)
    alone = RegionProjection(features, patch_weights).project(asked).weights
    held = RegionProjection(features, patch_weights, temporal=1.0).project(asked).weights
    assert float(held.diff(dim=0).abs().sum()) < 0.7 * float(alone.diff(dim=0).abs().sum())
    damped = RegionProjection(features, patch_weights, temporal=0.3).project(asked).weights
    assert torch.allclose(damped[0], alone[0], atol=1e-5)
    assert float(damped.diff(dim=0).abs().sum()) < float(alone.diff(dim=0).abs().sum())
    settled = RegionProjection(features, patch_weights, temporal=0.3).project(asked[:1].expand(40, -1, -1)).weights
    assert torch.allclose(settled[-1], alone[0], atol=0.02)
    first = RegionProjection(features, patch_weights, temporal=0.3).project(asked[1:], damped[0]).weights
    assert torch.allclose(first, damped[1:], atol=1e-5)


def _sequences(extremes: torch.Tensor) -> torch.Tensor:
    """Features of five frames each from rest to an extreme (S,4) and back, (5 S,6,9): motions that are not linear."""
    course = torch.linspace(0, torch.pi, 5).sin()
    amount = (course[None, :, None] * extremes[:, None]).flatten(0, 1)
    amount = torch.cat([amount, 0.2 * amount.square()], dim=1)
    return torch.einsum("km,mpc->kpc", amount, 0.1 * _random(8, 6, 9, seed=5))


def test_outside_is_what_the_databases_own_sequences_are_not() -> None:
    drawn = torch.rand(50, 4, generator=torch.Generator().manual_seed(4))
    drawn[:, 3] = 0.0  # a motion that the database never shows
    captured, others = drawn[:30], drawn[30:]
    projection = RegionProjection(_sequences(captured), torch.tensor([[1.0, 1, 1, 1, 0, 0], [0, 0, 0.5, 1, 1, 1]]))
    limits = projection.limits(torch.arange(30).repeat_interleave(5))

    def share(extremes: torch.Tensor) -> float:
        peaks = projection.project(_sequences(extremes)[2::5])
        return float((peaks.distances > limits).float().mean())

    held_out = projection.project(_sequences(others)).distances > limits
    assert float(held_out.float().mean()) < 0.03
    assert share(2 * others) > 0.7
    assert share(others + torch.tensor([0.0, 0, 0, 0.8])) == 1.0
    assert share(-0.5 * others) > 0.9


def test_sequences_of_an_expression_each_do_not_make_everything_inside(features, patch_weights) -> None:
    limits = RegionProjection(features, patch_weights).limits(torch.arange(20))
    assert torch.equal(limits, torch.tensor([0.75, 0.75]).double())
    assert torch.equal(RegionProjection(features, patch_weights).limits(torch.zeros(20).long()), limits)


def test_weights_are_differentiable_in_the_features(features):
    few = features[:6, :2]
    projection = RegionProjection(few, torch.tensor([[0.7, 0.3]]))
    asked = (0.05 * _random(1, 2, 9, seed=3) + few[:1]).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: projection.project(x).weights, (asked,), eps=1e-5, atol=1e-3, rtol=1e-3)


def test_other_shapes_are_refused(features, patch_weights):
    with pytest.raises(ShapeError, match=r"expected \(K,P,9\) and \(R,P\)"):
        RegionProjection(features, patch_weights[:, :5])
    with pytest.raises(ShapeError, match=r"expected \(T,12,9\)"):
        RegionProjection(features, patch_weights).project(features[:, :5])
