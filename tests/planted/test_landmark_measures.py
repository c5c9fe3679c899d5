"""Openings, blinks and agreements that were planted are found again."""

import math

import pytest
import torch
from torch import Tensor

from planted.landmark_measures import agreement, find_blinks, lid_openings, mouth_gap


def face(right: Tensor, left: Tensor, mouth: Tensor) -> Tensor:
    """Landmarks (T,68,2) with these openings (T,), the eyes' outer corners one apart."""
    marks = torch.zeros(len(right), 68, 2)
    marks[:, 45, 0] = 1.0
    for rows, gap, middle in (
        (((37, 41), (38, 40)), right, (0.2, 0.01)),
        (((43, 47), (44, 46)), left, (0.8, -0.01)),
        (((61, 67), (62, 66), (63, 65)), mouth, (0.5, 0.9)),
    ):
        for upper, lower in rows:
            marks[:, upper] = torch.tensor(middle) - torch.stack([0 * gap, gap / 2], 1)
            marks[:, lower] = torch.tensor(middle) + torch.stack([0 * gap, gap / 2], 1)
    return marks


def test_planted_openings_at_any_place_size_and_tilt() -> None:
    right, left, mouth = torch.tensor([0.1, 0.05, -0.01]), torch.tensor([0.09, 0.0, 0.1]), torch.tensor([0.0, 0.2, 0.4])
    marks = face(right, left, mouth)
    for tilt, size in ((0.0, 1.0), (0.7, 90.0), (math.pi, 30.0)):
        turn = torch.tensor([[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]])
        seen = size * marks @ turn.T + torch.tensor([300.0, -20.0])
        torch.testing.assert_close(lid_openings(seen), torch.stack([right, left], 1), atol=1e-5, rtol=0)
        torch.testing.assert_close(mouth_gap(seen), mouth, atol=1e-5, rtol=0)


def test_planted_blinks() -> None:
    openings = torch.full((60,), 0.1)
    openings[10:14] = torch.tensor([0.06, 0.01, 0.02, 0.065])
    openings[30] = 0.03
    openings[40:45] = 0.08  # half a blink is none
    openings[50] = torch.nan
    openings[57:] = 0.0
    assert find_blinks(openings).tolist() == [[10, 13], [30, 30], [57, 59]]
    assert find_blinks(openings[14:30]).shape == (0, 2)
    assert find_blinks(openings[:0]).shape == (0, 2)


def test_agreement_with_a_damped_copy() -> None:
    reference = torch.rand(200, 2, generator=torch.Generator().manual_seed(0))
    found = 0.6 * reference + 0.3
    found[5, 0] = torch.nan
    exact = agreement(found, reference)
    assert exact == pytest.approx((1, 0.6), abs=1e-6)
    noise = torch.randn(200, 2, generator=torch.Generator().manual_seed(1)) * 0.6 / math.sqrt(12)
    assert agreement(found + noise, reference).correlation == pytest.approx(math.sqrt(0.5), abs=0.05)
    assert agreement(-reference, reference) == pytest.approx((-1, -1))
    assert math.isnan(agreement(reference, torch.ones(200, 2)).slope)
