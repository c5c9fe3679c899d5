"""What the learned map adds: nothing in the hull, the planted linear law beyond it, and ever less far away."""

import pytest
import torch

from torchface.enhancement.detail.detail_basis import region_products
from torchface.enhancement.matching.learned_map import LearnedMap, map_shares
from torchface.enhancement.matching.region_projection import RegionProjection


@pytest.fixture(scope="module")
def planted():
    """Features of four patches in three dimensions, and coefficients that are linear in them."""
    torch.manual_seed(0)
    axes, law = 0.1 * torch.randn(3, 4, 9), torch.randn(3, 5)
    places = torch.rand(60, 3)
    features = torch.einsum("kd,dpc->kpc", places, axes)
    projection = RegionProjection(features, torch.tensor([[1.0, 1, 1, 1], [1, 1, 0.2, 0]]), ridge=1e-8)
    return axes, law, places, projection, LearnedMap(projection, places @ law)


def test_frames_beyond_the_hull_follow_the_law(planted):
    axes, law, drawn, projection, learned = planted
    places = torch.tensor([[1.2, 0.5, 0.5], [0.5, -0.2, 1.1], [0.4, 0.5, 0.6]])
    features = torch.einsum("kd,dpc->kpc", places, axes)
    matched = projection.project(features)
    added = learned.corrections(features, matched, torch.ones(2), torch.ones(2))
    assert float(added[:2].norm(dim=2).min()) > 0.1
    assert float(added[2].norm(dim=1).max()) < 0.02
    blends = (matched.weights @ drawn) @ law
    assert torch.allclose(blends + added, (places @ law)[:, None].expand(-1, 2, -1), atol=0.03)


def test_far_away_it_fades(planted):
    axes, _, _, projection, learned = planted
    sizes = []
    for far in (5.0, 50.0, 500.0):
        features = torch.einsum("kd,dpc->kpc", torch.tensor([[far, 0.5, 0.5]]), axes)
        matched = projection.project(features)
        sizes.append(learned.corrections(features, matched, torch.ones(2), torch.ones(2)).norm(dim=2))
    assert torch.allclose(sizes[1], 10 * sizes[2], rtol=0.2)
    assert float((sizes[1] / sizes[0]).max()) < 0.2


def test_a_law_counts_whole_and_chance_does_not(planted):
    """Sequences that go their own way are explained by the law, and by no map where detail is drawn at random."""
    axes, law, _, _, _ = planted
    torch.manual_seed(3)
    sequences = torch.arange(8).repeat_interleave(12)
    directions = torch.nn.functional.one_hot(torch.arange(8) % 3, 3) * torch.linspace(0.5, 1.5, 8)[:, None]
    places = directions[sequences] * torch.linspace(0, 1, 12).repeat(8)[:, None] + 0.05 * torch.rand(96, 3)
    features = torch.einsum("kd,dpc->kpc", places, axes)
    projection = RegionProjection(features, torch.tensor([[1.0, 1, 1, 1], [1, 1, 0.2, 0]]))
    products = torch.eye(5).expand(2, 5, 5)
    reach = torch.ones(2)
    assert float(map_shares(projection, places @ law, reach, products, sequences).min()) > 0.95
    assert float(map_shares(projection, torch.randn(96, 5), reach, products, sequences).max()) < 0.3
    half = torch.cat([places @ law, torch.randn(96, 5)], dim=1)
    seen = torch.tensor([[1.0] * 5 + [0.0] * 5, [0.0] * 5 + [1.0] * 5]).diag_embed()
    first, second = map_shares(projection, half, reach, seen, sequences).tolist()
    assert first > 0.95
    assert second < 0.3


def test_one_sequence_says_nothing_of_others(planted):
    _, law, places, projection, _ = planted
    shares = map_shares(projection, places @ law, torch.ones(2), torch.eye(5).expand(2, 5, 5), torch.zeros(60).long())
    assert shares.tolist() == [1, 1]


def test_products_are_those_of_blended_details():
    torch.manual_seed(0)
    components, weights, coefficients = torch.randn(4, 3 * 10), torch.rand(2, 10), torch.randn(4)
    details = (coefficients @ components).view(3, 10)
    expected = [float((own * details.square()).sum()) for own in weights]
    products = region_products(components, weights).float()
    assert torch.allclose(coefficients @ products @ coefficients, torch.tensor(expected), rtol=1e-5)
