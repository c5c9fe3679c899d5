"""Kalman filters: the optimum that linear algebra gives, less jitter, no lag, gaps filled."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from planted.take_filters import filtered
from torchface.errors import ShapeError, ValueRangeError
from torchface.temporal import KalmanFilter, KalmanSettings, kalman_smoother


def head_motion(frames: int = 400, channels: int = 20) -> Tensor:
    """Pixels of points on a head that turns and nods, 30 frames a second."""
    generator = torch.Generator().manual_seed(0)
    time = torch.arange(frames, dtype=torch.float64)[:, None] / 30
    swing = 40 * torch.rand(1, channels, generator=generator, dtype=torch.float64) + 10
    phase = 6.3 * torch.rand(1, channels, generator=generator, dtype=torch.float64)
    return 320 + swing * (2 * math.pi * 0.4 * time + phase).sin() + 0.3 * swing * (2 * math.pi * 0.9 * time).cos()


def measured(truth: Tensor, noise: float = 1.5) -> Tensor:
    return truth + noise * torch.randn(truth.shape, generator=torch.Generator().manual_seed(1), dtype=truth.dtype)


def jitter(values: Tensor) -> Tensor:
    return values[20:].diff(n=2, dim=0).square().mean().sqrt()


def lag(values: Tensor, truth: Tensor) -> float:
    """Frames by which values trail the truth: where their mean squared distance is least, between frames too."""
    errors = [(values[30:-6] - truth[30 - d : len(truth) - 6 - d]).square().mean() for d in range(-5, 6)]
    best = min(range(1, 10), key=lambda i: errors[i])
    before, here, after = errors[best - 1], errors[best], errors[best + 1]
    return best - 5 + 0.5 * float((before - after) / (before - 2 * here + after))


@pytest.mark.parametrize("damping", [1.0, 0.9])
def test_the_last_filtered_frame_is_the_least_squares_solution(damping: float) -> None:
    values = measured(head_motion(12, 2))
    settings = KalmanSettings(1.5, 0.4, damping=damping)
    transition, noise = KalmanFilter(1, settings)._transition, KalmanFilter(1, settings)._noise[0]
    frames = len(values)
    # All frames' states at once: measurements, transitions and what is known of the first, each over its deviation.
    first = torch.diag(torch.tensor([1.5, 45.0, 45.0], dtype=torch.float64)).inverse()
    root = torch.linalg.cholesky(noise).inverse()
    rows, sides = [torch.zeros(3, 3 * frames, dtype=torch.float64)], [torch.zeros(3, 2, dtype=torch.float64)]
    rows[0][:, :3], sides[0][0] = first, values[0] / 1.5
    for t in range(1, frames):
        row = torch.zeros(3, 3 * frames, dtype=torch.float64)
        row[:, 3 * t : 3 * t + 3], row[:, 3 * t - 3 : 3 * t] = root, -root @ transition
        seen = torch.zeros(1, 3 * frames, dtype=torch.float64)
        seen[0, 3 * t] = 1 / 1.5
        rows += [row, seen]
        sides += [torch.zeros(3, 2, dtype=torch.float64), values[t : t + 1] / 1.5]
    states = torch.linalg.lstsq(torch.cat(rows), torch.cat(sides)).solution[::3]
    torch.testing.assert_close(filtered(KalmanFilter(2, settings), values)[-1], states[-1], rtol=0, atol=1e-8)
    torch.testing.assert_close(kalman_smoother(values, settings), states, rtol=0, atol=1e-7)


def test_jitter_falls_by_three_fifths_without_a_frame_of_lag() -> None:
    truth = head_motion()
    values = measured(truth)
    settings = KalmanSettings(1.44, 0.1)  # the likeliest, a little calmer
    live, smoothed = filtered(KalmanFilter(20, settings), values), kalman_smoother(values, settings)
    assert jitter(live - truth) < 0.4 * jitter(values - truth)
    assert abs(lag(live, truth)) < 1
    assert jitter(smoothed - truth) < 0.1 * jitter(values - truth)
    assert abs(lag(smoothed, truth)) < 0.1
    error = [(kept - truth)[20:].square().mean() for kept in (values, live, smoothed)]
    assert error[2] < error[1] < error[0]


def test_gaps_are_filled_and_long_ones_are_not_made_up() -> None:
    truth = head_motion(120, 3)
    values = measured(truth, 0.3)
    values[:5, 0], values[50:56, 1], values[40:80, 2] = torch.nan, torch.nan, torch.nan
    settings = KalmanSettings(0.3, 0.3, longest_gap=8)
    live, smoothed = filtered(KalmanFilter(3, settings), values), kalman_smoother(values, settings)
    assert live[:5, 0].isnan().all()
    assert float((live[50:56, 1] - truth[50:56, 1]).abs().max()) < 8
    assert live[40:48, 2].isfinite().all()
    assert live[48:80, 2].isnan().all()
    assert live[80:, 2].isfinite().all()
    assert float((smoothed[50:56, 1] - truth[50:56, 1]).abs().max()) < 1
    assert smoothed[5:].isfinite().all()
    assert smoothed[:5, 0].isnan().all()


@given(st.integers(1, 30), st.integers(1, 3), st.integers(0, 10**6))
def test_any_pattern_of_gaps(frames: int, channels: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(frames, channels, generator=generator)
    values[torch.rand(values.shape, generator=generator) < 0.4] = torch.nan
    settings = KalmanSettings(0.5, 0.2, longest_gap=frames)
    live, smoothed = filtered(KalmanFilter(channels, settings), values), kalman_smoother(values, settings)
    unseen = values.isfinite().cumsum(0) == 0
    assert torch.equal(live.isnan(), unseen)
    assert torch.equal(smoothed.isnan(), unseen)


def test_bad_input() -> None:
    with pytest.raises(ValueRangeError, match="positive deviations"):
        KalmanSettings(0.0, 1.0)
    with pytest.raises(ValueRangeError, match="different damping"):
        KalmanFilter(2, [KalmanSettings(1, 1), KalmanSettings(1, 1, damping=0.5)])
    with pytest.raises(ShapeError, match="found 3 settings, expected one or 2"):
        KalmanFilter(2, [KalmanSettings(1, 1)] * 3)
    with pytest.raises(ShapeError, match="a frame at least"):
        kalman_smoother(torch.zeros(0, 2), KalmanSettings(1, 1))
    with pytest.raises(ValueRangeError, match="infinite"):
        kalman_smoother(torch.full((3, 1), torch.inf), KalmanSettings(1, 1))
    with pytest.raises(ValueRangeError, match="infinite"):
        KalmanFilter(1, KalmanSettings(1, 1)).step(torch.full((1,), torch.inf))


def test_what_was_returned_may_be_changed() -> None:
    changed, kept = (KalmanFilter(1, KalmanSettings(measurement=0.5, jerk=0.01)) for _ in range(2))
    for place in (1.0, 2.0, 1.5):
        changed.step(torch.tensor([place])).sub_(100)
        kept.step(torch.tensor([place]))
    assert torch.equal(changed.step(torch.tensor([torch.nan])), kept.step(torch.tensor([torch.nan])))


def test_two_short_steps_are_a_long_one() -> None:
    once, twice = (KalmanFilter(2, KalmanSettings(1.5, 0.4)) for _ in range(2))
    for running in (once, twice):
        for frame in torch.tensor([[0.0, 5.0], [1.0, 4.0], [3.0, 4.5]], dtype=torch.float64):
            running.step(frame)
    once.predict(1.3)
    for interval in (0.5, 0.8):
        twice.predict(interval)
    torch.testing.assert_close(once.state, twice.state)
    torch.testing.assert_close(once.covariance, twice.covariance)
