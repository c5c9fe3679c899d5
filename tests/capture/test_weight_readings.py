"""Readings of weights are Gaussian terms of what they read."""

import pytest
import torch

from torchface.capture.weight_readings import WeightReadings
from torchface.errors import ShapeError
from torchface.shape_names import ARKIT

NAMES = ("jawOpen", "browInnerUp_L", "browInnerUp_R", "eyeBlinkLeft", "anotherShape")


def drawn(frames: int = 3) -> WeightReadings:
    generator = torch.Generator().manual_seed(1)
    expression, deviation = torch.rand(frames, 52, generator=generator), 0.05 + torch.rand(52, generator=generator)
    expression[1, ARKIT.index("jawOpen")] = torch.nan
    deviation = deviation.repeat(frames, 1)
    deviation[2, ARKIT.index("eyeBlinkLeft")] = torch.inf
    return WeightReadings.of_expression(expression, deviation, NAMES)


def test_the_energy_is_the_squared_error_in_deviations() -> None:
    read = drawn()
    weights = torch.rand(3, 5, dtype=torch.float64, requires_grad=True)
    scaled = (weights @ read.rows.double().T - read.values) / read.deviation
    known = torch.isfinite(read.deviation) & ~torch.isnan(read.values)
    expected = 0.5 * torch.where(known, scaled, 0.0).square().sum()
    (slope,) = torch.autograd.grad(expected, weights)
    energy = read.energy()
    found = energy.f + (energy.H @ weights[..., None])[..., 0]
    assert torch.allclose(found, slope, rtol=1e-6)


def test_what_was_not_read_says_nothing() -> None:
    H = drawn().energy().H
    assert float(H[1, 0, 0]) == 0  # NaN
    assert float(H[2, 3, 3]) == 0  # infinitely uncertain
    assert float(H[:, 4].abs().max()) == 0  # unknown to ARKit
    assert bool((H.diagonal(dim1=1, dim2=2)[0, :4] > 0).all())


def test_readings_beside_others_add() -> None:
    read = drawn()
    twice = read.beside(read).energy()
    assert torch.allclose(twice.H, 2 * read.energy().H)
    assert torch.equal(read.beside(read).of_frames(torch.tensor([2])).values, read.values[2:].repeat(1, 2))


def test_parts_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ShapeError, match="found 3 values a frame, expected 2"):
        WeightReadings(torch.zeros(2, 5), torch.zeros(4, 3), torch.ones(4, 3))
    with pytest.raises(ShapeError, match="expected"):
        WeightReadings(torch.zeros(2, 5), torch.zeros(4, 2), torch.ones(4, 3))


def test_a_reading_of_blinks_is_outweighed_by_openness() -> None:
    """An expression network that surely sees no blink, beside an eye that is measured 0.6 closed to 0.1."""
    expression, sure = torch.zeros(1, 52).double(), torch.full((1, 52), 0.02).double()
    read = WeightReadings.of_expression(expression, sure, ARKIT)
    blink, jaw = ARKIT.index("eyeBlinkLeft"), ARKIT.index("jawOpen")
    row = torch.eye(52).double()[[blink]]
    both = read.beside(WeightReadings(row, torch.tensor([[0.6]]).double(), torch.tensor([[0.1]]).double())).energy()
    weights = torch.linalg.solve(both.H[0], -both.f[0])
    assert float(weights[blink]) > 0.45
    assert float(both.H[0, jaw, jaw]) == pytest.approx(0.02**-2)
