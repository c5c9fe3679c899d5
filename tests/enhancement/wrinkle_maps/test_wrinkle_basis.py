"""Maps of wrinkles that weights of regions mix."""

import pytest
import torch
from torch import Tensor

from tests.enhancement.conftest import Database
from torchface.enhancement import EnhancementModel
from torchface.enhancement.detail.detail_basis import LearnedBasis, StreamingBasis
from torchface.enhancement.detail.low_pass import vertex_areas
from torchface.enhancement.wrinkle_maps.wrinkle_basis import WrinkleBasis, learn_wrinkle_basis


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def as_basis(rows: Tensor, rank: int) -> LearnedBasis:
    """Rows (K,n) as their components and coefficients."""
    found = StreamingBasis(rows.shape[1], rank)
    found.add(rows.clone())
    return found.finished()


@pytest.fixture(scope="module")
def shares(model: EnhancementModel) -> Tensor:
    return model.vertex_weights


def test_the_weights_of_planted_maps_are_found(database: Database, shares: Tensor, model: EnhancementModel) -> None:
    count = len(database.neutral)
    maps = torch.randn(1, 3, count, generator=seeded())
    weights = torch.rand(40, len(shares), 1, generator=seeded(1))
    weights = weights / weights.amax(0)
    areas = vertex_areas(database.neutral, database.faces)
    details = as_basis(WrinkleBasis(maps, shares, areas).details(weights), 40)
    found = learn_wrinkle_basis(details, shares, areas, 1)
    # Where regions share a border one may have a little of the other's: it shows in no vertex.
    assert (found.weights(details) - weights).abs().mean() < 0.025
    assert (found.maps - maps).square().mean().sqrt() < 0.04
    assert found.missed_share(found.weights(details), details) < 0.01


def test_more_maps_show_more_and_the_share_missed_is_what_it_is(
    database: Database, shares: Tensor, model: EnhancementModel
) -> None:
    areas = vertex_areas(database.neutral, database.faces).float()
    rows = (database.frames - database.smooth).transpose(1, 2).flatten(1).contiguous()
    details = as_basis(rows, 36)
    missed = []
    for count in (1, 3):
        basis = learn_wrinkle_basis(details, shares, areas, count)
        weights = basis.weights(details)
        assert float(weights.min()) >= 0
        assert float(weights.max()) <= 1
        left = (basis.details(weights) - rows).square() * areas.repeat(3)
        assert basis.missed_share(weights, details) == pytest.approx(
            float((left.sum() / (rows.square() * areas.repeat(3)).sum()).sqrt()), abs=2e-3
        )
        missed.append(basis.missed_share(weights, details))
    assert missed[1] < 0.5 * missed[0]
    assert missed[1] < 0.055
