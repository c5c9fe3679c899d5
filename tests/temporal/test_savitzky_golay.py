"""Savitzky-Golay: what polynomials fitted window by window say."""

import numpy as np
import pytest
import torch

from torchface.errors import ShapeError, ValueRangeError
from torchface.temporal import KalmanSettings, adaptive_filter, adaptive_smoother, kalman_smoother, savitzky_golay


@pytest.mark.parametrize(("frames", "window", "order"), [(40, 15, 2), (15, 15, 2), (9, 5, 3), (31, 21, 0)])
def test_each_frame_is_read_off_the_polynomial_fitted_round_it(frames: int, window: int, order: int) -> None:
    values = torch.randn(frames, generator=torch.Generator().manual_seed(frames), dtype=torch.float64)
    expected = []
    for frame in range(frames):
        first = min(max(frame - window // 2, 0), frames - window)
        around = np.arange(first, first + window)
        expected.append(np.polyval(np.polyfit(around - frame, values[around].numpy(), order), 0))
    np.testing.assert_allclose(savitzky_golay(values, window, order).numpy(), expected, atol=1e-10)


def test_a_gap_spoils_the_windows_that_hold_it_and_no_others() -> None:
    values = torch.rand(60, 1, generator=torch.Generator().manual_seed(0))
    values[30] = torch.nan
    assert savitzky_golay(values, 15).isnan().nonzero()[:, 0].tolist() == list(range(23, 38))


def test_whole_numbers_are_smoothed_as_they_are() -> None:
    pixels = torch.randint(0, 9, (12, 2, 3), generator=torch.Generator().manual_seed(0))
    settings = KalmanSettings(measurement=0.3, jerk=20.0)
    smoothers = (lambda x: savitzky_golay(x, 5), adaptive_filter, adaptive_smoother)
    for smooth in (*smoothers, lambda x: kalman_smoother(x, settings)):
        torch.testing.assert_close(smooth(pixels), smooth(pixels.float()))


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
