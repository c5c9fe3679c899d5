"""Energies mean what their formulas say, in mm² a marker, and add."""

import pytest
import torch
from torch import Tensor

from torchface.capture.energy import Quadratic, marker_term, ridge_term, sparsity_term
from torchface.errors import ShapeError, ValueRangeError


def layout(markers: int = 9, shapes: int = 5, frames: int = 6) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    return draw(markers, 3, shapes), draw(markers, 3), 3 * draw(frames, markers, 3), draw(frames, shapes)


def distance(basis: Tensor, rest: Tensor, targets: Tensor, weights: Tensor) -> Tensor:
    """Mean over the seen markers, frame by frame."""
    means = []
    for target, weight in zip(targets, weights, strict=True):
        seen = ~torch.isnan(target).any(-1)
        means.append((rest + basis @ weight - target)[seen].square().sum(-1).mean())
    return torch.stack(means)


@pytest.mark.parametrize("gaps", [False, True])
def test_the_marker_term_is_the_mean_squared_distance(gaps: bool) -> None:
    basis, rest, targets, weights = layout()
    if gaps:
        targets[1, 3] = torch.nan
        targets[2, 5:, 1] = torch.nan
    term = marker_term(basis, rest, targets)
    assert term.H.ndim == (3 if gaps else 2)
    torch.testing.assert_close(term.value(weights), distance(basis, rest, targets, weights))


def test_its_gradient_is_hw_plus_f() -> None:
    basis, rest, targets, weights = layout()
    targets[0, 0] = torch.nan
    term = marker_term(basis, rest, targets)
    weights.requires_grad_()
    (gradient,) = torch.autograd.grad(distance(basis, rest, targets, weights).sum(), weights)
    torch.testing.assert_close(torch.bmm(term.H, weights[..., None])[..., 0] + term.f, gradient)


def test_doubling_the_markers_changes_nothing() -> None:
    basis, rest, targets, _ = layout()
    one = marker_term(basis, rest, targets)
    two = marker_term(basis.repeat(2, 1, 1), rest.repeat(2, 1), targets.repeat(1, 2, 1))
    torch.testing.assert_close(one.H, two.H)
    torch.testing.assert_close(one.f, two.f)


def test_a_frame_without_markers_has_no_energy() -> None:
    basis, rest, targets, weights = layout()
    targets[4] = torch.nan
    assert float(marker_term(basis, rest, targets).value(weights)[4]) == 0


def test_terms_add_and_scale() -> None:
    basis, rest, targets, weights = layout()
    targets[0, 0] = torch.nan
    markers = marker_term(basis, rest, targets)
    total = markers + sparsity_term(5, 0.7, weights) + 2.0 * ridge_term(5, 0.2, weights)
    wanted = markers.value(weights) + 0.7 * weights.sum(-1) + 0.4 * weights.square().sum(-1)
    torch.testing.assert_close(total.value(weights), wanted)


def test_what_does_not_fit_is_refused() -> None:
    basis, rest, targets, weights = layout()
    with pytest.raises(ShapeError, match="marker_term"):
        marker_term(basis, rest[:-1], targets)
    targets[3, 2, 0] = torch.inf
    with pytest.raises(ValueRangeError, match=r"frames \[3\]"):
        marker_term(basis, rest, targets)
    with pytest.raises(ValueRangeError, match=r"sparsity: found -1"):
        sparsity_term(5, -1.0, weights)
    with pytest.raises(ShapeError, match="in a sum"):
        sparsity_term(5, 1.0, weights) + sparsity_term(4, 1.0, weights)
    with pytest.raises(ShapeError, match="quadratic"):
        Quadratic(torch.eye(3), torch.zeros(2, 4))
