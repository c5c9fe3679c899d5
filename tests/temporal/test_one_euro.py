"""Calm at rest, quick in motion, and never ahead of its time."""

import math

import pytest
import torch

from planted.take_filters import filtered
from torchface import Attachment, BlendshapeRig
from torchface.capture import MarkerSolver
from torchface.errors import ShapeError, ValueRangeError
from torchface.evaluation import weight_jitter
from torchface.synthetic.stages.marker_stage import record
from torchface.temporal import OneEuroFilter, OneEuroSettings
from torchface.temporal.one_euro import one_euro_step

FPS = 60.0


def test_agrees_with_the_published_recursion() -> None:
    settings = OneEuroSettings(1.2, 4.0, 0.9)
    values = torch.randn(40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def alpha(cutoff: float) -> float:
        tau = 1 / (2 * math.pi * cutoff)
        return 1 / (1 + tau * FPS)

    value, speed, theirs = float(values[0]), 0.0, [float(values[0])]
    for measured in values[1:].tolist():
        rate = alpha(settings.speed_cutoff)
        speed = rate * (measured - value) * FPS + (1 - rate) * speed
        share = alpha(settings.cutoff + settings.speed * abs(speed))
        value = share * measured + (1 - share) * value
        theirs.append(value)
    found = filtered(OneEuroFilter(FPS, settings), values)
    torch.testing.assert_close(found, torch.tensor(theirs, dtype=torch.float64), rtol=0, atol=1e-12)


def test_noise_at_rest_is_calmed_and_a_blink_comes_in_time() -> None:
    noise = 0.03 * torch.randn(300, 8, generator=torch.Generator().manual_seed(1))
    assert weight_jitter(filtered(OneEuroFilter(FPS), 0.4 + noise)) < 0.15 * weight_jitter(noise)
    seconds = torch.arange(120) / FPS
    blink = torch.exp(-((seconds - 1.0) ** 2) / (2 * 0.05**2))
    calm = filtered(OneEuroFilter(FPS), blink[:, None])[:, 0]
    assert float(calm.max()) > 0.8
    assert 0 <= int(calm.argmax()) - int(blink.argmax()) <= 2


def test_what_is_not_seen_stays_and_bad_input_is_named() -> None:
    running = OneEuroFilter(FPS)
    assert running.step(torch.tensor([0.5, math.nan])).tolist()[0] == 0.5
    held = running.step(torch.tensor([math.nan, 0.25]))
    assert held.tolist() == [0.5, 0.25]
    with pytest.raises(ShapeError, match=r"found \(3,\), expected \(2,\)"):
        running.step(torch.zeros(3))
    running.reset()
    assert running.step(torch.zeros(3)).tolist() == [0, 0, 0]
    with pytest.raises(ValueRangeError, match="found 0 frames a second"):
        OneEuroFilter(0)
    with pytest.raises(ValueRangeError, match="cutoff: found 0"):
        OneEuroSettings(cutoff=0)


def test_a_step_takes_any_interval_unit_and_opening() -> None:
    """Twice the unit of twice the values is the same; a wider opening is a higher cutoff."""
    settings, zero, one = OneEuroSettings(1.2, 4.0, 0.9), torch.zeros(1).double(), torch.ones(1).double()
    plain, speed = one_euro_step(one, zero, zero, 0.1, settings)
    double, faster = one_euro_step(2 * one, zero, zero, torch.tensor(0.1), settings, unit=2.0)
    torch.testing.assert_close(double, 2 * plain)
    torch.testing.assert_close(faster, 2 * speed)
    opened = one_euro_step(one, zero, zero, 0.1, settings, opening=3.0)
    torch.testing.assert_close(opened, one_euro_step(one, zero, zero, 0.1, OneEuroSettings(3.6, 12.0, 0.9)))


@pytest.mark.real
def test_a_real_take_is_calmer_and_closer_at_a_lag_of_two_frames_at_most(
    real_capture: tuple[BlendshapeRig, Attachment, list[torch.Tensor]],
) -> None:
    rig, attachment, takes = real_capture
    true = takes[2][300:700].float()
    take = record(rig, attachment, true, torch.Generator().manual_seed(1)).take
    single = MarkerSolver(rig, attachment)(take.markers.values)
    streamed = filtered(OneEuroFilter(FPS), single)
    assert weight_jitter(streamed) < 0.35 * weight_jitter(single)
    assert (streamed - true).abs().mean() < 0.9 * (single - true).abs().mean()
    active = true.std(0) > 0.03
    off = [(streamed[10:, active] - true[10 - lag : len(true) - lag, active]).square().mean() for lag in range(6)]
    assert off.index(min(off)) <= 2
