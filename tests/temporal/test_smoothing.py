"""Savitzky–Golay against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.signal import savgol_filter

from torchface.errors import ShapeError, ValueRangeError
from torchface.temporal import savitzky_golay


@pytest.mark.parametrize(("frames", "window", "order"), [(40, 15, 2), (15, 15, 2), (9, 5, 3), (31, 21, 0)])
def test_agrees_with_scipy(frames: int, window: int, order: int) -> None:
    values = torch.randn(frames, 3, generator=torch.Generator().manual_seed(frames), dtype=torch.float64)
    theirs = savgol_filter(values.numpy(), window, order, axis=0, mode="interp")
    np.testing.assert_allclose(savitzky_golay(values, window, order).numpy(), theirs, atol=1e-12)


def test_a_parabola_stays_as_it_is() -> None:
    time = torch.arange(50, dtype=torch.float64)
    curve = 0.3 * time**2 - time + 2
    assert torch.allclose(savitzky_golay(curve, 15, 2), curve, atol=1e-9)


def test_an_even_window_counts_as_the_next_odd_one() -> None:
    values = torch.rand(60, 2, generator=torch.Generator().manual_seed(0))
    assert torch.equal(savitzky_golay(values, 20), savitzky_golay(values, 21))


@pytest.mark.parametrize("frames", [1, 2, 3, 4])
def test_takes_shorter_than_the_window(frames: int) -> None:
    assert torch.allclose(savitzky_golay(torch.full((frames, 2), 0.7), 15), torch.tensor(0.7))


def test_bad_input() -> None:
    with pytest.raises(ShapeError, match="a frame at least"):
        savitzky_golay(torch.zeros(0, 2), 15)
    with pytest.raises(ValueRangeError, match="0 <= order < window"):
        savitzky_golay(torch.zeros(9), 3, 3)
