"""A filter that finds its settings while it runs: as good as the best that are set; landmarks of faces."""

import math
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from planted.take_filters import filtered
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.pnp import pixel_jacobian
from torchface.geometry.rotations import rotation_matrix
from torchface.io import load_take
from torchface.synthetic import performer
from torchface.temporal import (
    AdaptiveFilter,
    AdaptiveSettings,
    KalmanFilter,
    KalmanSettings,
    adaptive_filter,
    adaptive_smoother,
)
from torchface.temporal.adaptive_kalman import LANDMARK_SETTINGS


def motion(size: float, frames: int = 240, points: int = 8) -> Tensor:
    """Points that swing by ``size`` pixels, 30 frames a second, with a third as much twice as quick: (T,P,2)."""
    generator = torch.Generator().manual_seed(0)
    time = torch.arange(frames, dtype=torch.float64)[:, None, None] / 30
    phase = 6.3 * torch.rand(1, points, 2, generator=generator, dtype=torch.float64)
    return 300 + size * ((2 * math.pi * 0.4 * time + phase).sin() + 0.3 * (2 * math.pi * 0.9 * time).cos())


def noisy(truth: Tensor, noise: float) -> Tensor:
    return truth + noise * torch.randn(truth.shape, generator=torch.Generator().manual_seed(1), dtype=truth.dtype)


def jitter(values: Tensor) -> float:
    return float(values[20:].diff(n=2, dim=0).square().mean().sqrt())


@pytest.mark.parametrize(
    ("size", "noise", "most"),
    [
        (40.0, 1.5, 0.4),
        (0.0, 1.5, 0.18),
        pytest.param(4.0, 1.5, 0.25, marks=pytest.mark.bench),
        pytest.param(40.0, 3.5, 0.35, marks=pytest.mark.bench),
    ],
)
def test_as_good_as_the_best_settings_whatever_moves(size: float, noise: float, most: float) -> None:
    truth = motion(size)
    values = noisy(truth, noise)
    found = adaptive_filter(values)
    assert jitter(found - truth) < most * jitter(values - truth)
    error = (found - truth)[30:].square().mean().sqrt()
    for jerk in torch.logspace(-3, 0, 7).tolist():
        alone = filtered(KalmanFilter(16, KalmanSettings(noise, jerk)), values.flatten(1)).reshape(values.shape)
        assert error < 1.25 * (alone - truth)[30:].square().mean().sqrt()
    smoothed = adaptive_smoother(values)
    assert jitter(smoothed - truth) < 0.03 * jitter(values - truth)
    assert (smoothed - truth)[30:].square().mean().sqrt() < 0.65 * error


def test_each_point_for_itself() -> None:
    truth = torch.cat([motion(40.0), motion(0.0)], dim=1)
    values = truth + torch.cat([noisy(motion(0.0), 0.4), noisy(motion(0.0), 3.0)], dim=1) - 300
    running = AdaptiveFilter(16, 2)
    for frame in values:
        running.step(frame)
    combinations = running.settings.combinations()
    likely = [combinations[m] for m in running.scores.argmax(0).tolist()]
    assert {one.measurement for one in likely[:8]} <= {0.2, 0.6}
    assert {one.measurement for one in likely[8:]} <= {1.5, 4.0}
    assert min(one.jerk for one in likely[:8]) > max(one.jerk for one in likely[8:])


def test_one_model_is_the_kalman_filter() -> None:
    values = noisy(motion(10.0, 40, 3), 1.0)
    values[10:14, 1] = torch.nan
    alone = AdaptiveSettings((1.0,), (0.1,), longest_gap=2, damping=0.9)
    running = KalmanFilter(6, KalmanSettings(1.0, 0.1, 2, 0.9))
    expected = filtered(running, values.flatten(1)).reshape(values.shape)
    torch.testing.assert_close(adaptive_filter(values, alone), expected, equal_nan=True)


@settings(max_examples=15)
@given(st.integers(1, 25), st.integers(0, 10**6), st.integers(0, 5))
def test_any_pattern_of_gaps(frames: int, seed: int, longest: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(frames, 2, 2, generator=generator)
    unseen = torch.rand(frames, 2, generator=generator) < 0.5
    values[unseen] = torch.nan
    chosen = AdaptiveSettings((0.5, 1.0), (0.1, 0.3), longest_gap=longest)
    smoothed = adaptive_smoother(values, chosen)
    live = adaptive_filter(values, chosen)
    assert torch.isfinite(live[~unseen]).all()
    assert torch.isfinite(smoothed[~unseen]).all()
    for point in range(2):
        run, begun = 0, False
        for t in range(frames):
            run = run + 1 if unseen[t, point] else 0
            begun = begun or run == 0
            assert bool(live[t, point].isnan().all()) == (not begun or run > longest)
            if not begun:
                assert smoothed[t, point].isnan().all()


def test_bad_input() -> None:
    with pytest.raises(ShapeError, match=r"found \(3, 2\), expected \(4, 2\)"):
        AdaptiveFilter(4, 2).step(torch.zeros(3, 2))
    with pytest.raises(ShapeError, match="expected \\(T,P,D\\)"):
        adaptive_smoother(torch.zeros(3, 2))
    with pytest.raises(ValueRangeError, match="infinite"):
        adaptive_filter(torch.full((2, 1, 1), torch.inf))
    with pytest.raises(ValueRangeError, match="rising"):
        AdaptiveSettings(jerk=(1.0, 0.1))
    with pytest.raises(ValueRangeError, match=r"damping 1\.5"):
        AdaptiveSettings(damping=1.5)
    with pytest.raises(ValueRangeError, match="calm 2"):
        AdaptiveSettings(calm=2.0)
    with pytest.raises(ValueRangeError, match="positive deviations"):
        AdaptiveSettings(measurement=(-1.0,))


@pytest.fixture(scope="module")
def face() -> Tensor:
    """The performer turns the head and opens and spreads the mouth, 30 frames a second: (T,68,2) pixels."""
    rig, time = performer(), torch.arange(180, dtype=torch.float64) / 30
    weights = torch.zeros(180, len(rig.names), dtype=torch.float64)
    weights[:, rig.names.index("jawOpen")] = 0.4 * (1 - (2 * math.pi * 1.5 * time).cos()) / 2
    weights[:, rig.names.index("mouthSmileLeft")] = 0.5 * (1 - (2 * math.pi * 0.7 * time).cos()) / 2
    ids = rig.neutral.landmarks
    points = rig.vertices[ids].double() + torch.einsum("tn,nlc->tlc", weights, rig.deltas[:, ids].double())
    turn = torch.stack([0.1 * (2.5 * time).sin(), 0.3 * (2.0 * time).sin(), 0.05 * time.cos()], dim=1)
    rotation = torch.diag(torch.tensor([1.0, -1, -1]).double()) @ rotation_matrix(turn)
    seen = points @ rotation.transpose(1, 2) + torch.tensor([0.0, 0, 600]).double()
    return pixel_jacobian(seen, assumed_calibration(640, 480).intrinsics)[0]


def test_less_jitter_live_and_hardly_any_afterwards(face: Tensor) -> None:
    noise = 1.5 * torch.randn(face.shape, generator=torch.Generator().manual_seed(0), dtype=face.dtype)
    values = face + noise
    values[60:64, 30:40] = torch.nan

    def jitter(each: Tensor) -> float:
        return float(each[70:].diff(n=2, dim=0).square().mean().sqrt())

    live, smoothed = adaptive_filter(values, LANDMARK_SETTINGS), adaptive_smoother(values, LANDMARK_SETTINGS)
    assert jitter(live - face) < 0.4 * jitter(noise)
    assert jitter(smoothed - face) < 0.1 * jitter(noise)
    # Whom the filtered landmarks are like most: the frame itself, not the one before.
    errors = [float((live[40:] - face[40 - lag : len(face) - lag])[30:].square().mean()) for lag in (0, 1, 2)]
    assert errors[0] < errors[1] < errors[2]
    assert float((live[60:64] - face[60:64]).norm(dim=-1).max()) < 15
    assert float((smoothed[60:64] - face[60:64]).norm(dim=-1).max()) < 5
    assert torch.equal(filtered(AdaptiveFilter(68, 2, LANDMARK_SETTINGS), values[:20]), live[:20])


@pytest.mark.real
def test_a_real_face_is_followed(data: Path) -> None:
    take = load_take(data / "landmarks" / "openface_100_frames.csv")
    values = take.landmarks.values.double()
    live, smoothed = adaptive_filter(values, LANDMARK_SETTINGS), adaptive_smoother(values, LANDMARK_SETTINGS)
    for found in (live, smoothed):
        assert float((found - values).norm(dim=-1).mean()) < 0.3
        assert float(found.diff(n=2, dim=0).norm(dim=-1).mean()) < 0.7 * float(
            values.diff(n=2, dim=0).norm(dim=-1).mean()
        )
