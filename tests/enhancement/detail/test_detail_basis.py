"""The basis of details: as good as an SVD of all rows at once, and blends are sums by region."""

import pytest
import torch

from torchface.enhancement.detail.detail_basis import StreamingBasis, blended


def _streamed(rows, rank, block):
    basis = StreamingBasis(rows.shape[1], rank)
    for some in rows.split(block):
        basis.add(some.clone())
    return basis.finished()


def test_as_many_components_as_rows_hold_everything():
    rows = torch.randn(20, 500, generator=torch.Generator().manual_seed(0))
    rows[3] = 0
    found = _streamed(rows, 20, 6)
    again = found.coefficients @ found.components.float()
    assert float((again - rows).norm() / rows.norm()) < 1e-3
    assert found.lost_share < 1e-6
    assert float(found.coefficients[3].abs().max()) < 1e-6


def test_fewer_components_are_nearly_the_best_there_are():
    generator = torch.Generator().manual_seed(1)
    mixed = torch.randn(60, 60, generator=generator) * 0.8 ** torch.arange(60)
    rows = mixed @ torch.randn(60, 400, generator=generator)
    found = _streamed(rows, 8, 9)
    values = torch.linalg.svdvals(rows).square()
    best = float(values[8:].sum() / values.sum())
    assert best <= found.lost_share + 1e-6 < 1.02 * best
    again = found.coefficients @ found.components.float()
    assert float((again - rows).square().sum() / rows.square().sum()) == pytest.approx(found.lost_share, rel=1e-3)


def test_a_blend_is_the_sum_over_regions():
    torch.manual_seed(2)
    components, coefficients = torch.randn(5, 3 * 70), torch.randn(4, 2, 5)
    weights = torch.rand(2, 70)
    weights = weights / weights.sum(0)
    expected = torch.einsum("trk,kcs,rs->tcs", coefficients, components.view(5, 3, 70), weights)
    assert torch.allclose(blended(components, coefficients, weights), expected.flatten(1), atol=1e-5)
