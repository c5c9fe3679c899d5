"""What the learned map adds: nothing in the hull, the planted linear law beyond it, and ever less far away."""

import pytest
import torch

from torchface.enhancement.learned_map import LearnedMap
from torchface.enhancement.projection import RegionProjection


@pytest.fixture(scope="module")
def planted():
    """Features of four patches in three dimensions, and coefficients that are linear in them."""
    torch.manual_seed(0)
    axes, law = 0.1 * torch.randn(3, 4, 9), torch.randn(3, 5)
    places = torch.rand(60, 3)
    features = torch.einsum("kd,dpc->kpc", places, axes)
    projection = RegionProjection(features, torch.tensor([[1.0, 1, 1, 1], [1, 1, 0.2, 0]]), ridge=1e-8)
    return axes, law, places, projection, LearnedMap(projection, places @ law, torch.tensor([1.0, 1.0]))


def test_frames_beyond_the_hull_follow_the_law(planted):
    axes, law, drawn, projection, learned = planted
    places = torch.tensor([[1.2, 0.5, 0.5], [0.5, -0.2, 1.1], [0.4, 0.5, 0.6]])
    features = torch.einsum("kd,dpc->kpc", places, axes)
    matched = projection.project(features)
    added = learned.corrections(features, matched)
    assert float(added[:2].norm(dim=2).min()) > 0.1
    assert float(added[2].norm(dim=1).max()) < 0.02
    blends = (matched.weights @ drawn) @ law
    assert torch.allclose(blends + added, (places @ law)[:, None].expand(-1, 2, -1), atol=0.03)


def test_far_away_it_fades(planted):
    axes, _, _, projection, learned = planted
    sizes = []
    for far in (5.0, 50.0, 500.0):
        features = torch.einsum("kd,dpc->kpc", torch.tensor([[far, 0.5, 0.5]]), axes)
        sizes.append(learned.corrections(features, projection.project(features)).norm(dim=2))
    assert torch.allclose(sizes[1], 10 * sizes[2], rtol=0.2)
    assert float((sizes[1] / sizes[0]).max()) < 0.2
