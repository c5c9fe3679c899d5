"""Landmarks of a moving, speaking head: less jitter, no lag, gaps bridged; and of a real video."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.capture.own_rig.landmark_smoothing import LandmarkFilter, filter_landmarks, smooth_landmarks
from torchface.errors import ShapeError
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.pnp import pixel_jacobian
from torchface.geometry.rotations import rotation_matrix
from torchface.io import load_take
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def truth() -> Tensor:
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


def test_less_jitter_live_and_hardly_any_afterwards(truth: Tensor) -> None:
    noise = 1.5 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0), dtype=truth.dtype)
    values = truth + noise
    values[60:64, 30:40] = torch.nan

    def jitter(each: Tensor) -> float:
        return float(each[70:].diff(n=2, dim=0).square().mean().sqrt())

    filtered, smoothed = filter_landmarks(values), smooth_landmarks(values)
    assert jitter(filtered - truth) < 0.4 * jitter(noise)
    assert jitter(smoothed - truth) < 0.1 * jitter(noise)
    # Whom the filtered landmarks are like most: the frame itself, not the one before.
    errors = [float((filtered[40:] - truth[40 - lag : len(truth) - lag])[30:].square().mean()) for lag in (0, 1, 2)]
    assert errors[0] < errors[1] < errors[2]
    assert float((filtered[60:64] - truth[60:64]).norm(dim=-1).max()) < 15
    assert float((smoothed[60:64] - truth[60:64]).norm(dim=-1).max()) < 5
    running = LandmarkFilter()
    assert torch.equal(torch.stack([running.step(frame) for frame in values[:20]]), filtered[:20])
    with pytest.raises(ShapeError, match=r"expected \(T,L,2\)"):
        smooth_landmarks(values[0])


@pytest.mark.real
def test_a_real_face_is_followed(data: Path) -> None:
    take = load_take(data / "landmarks" / "openface_100_frames.csv")
    assert take.landmarks is not None
    values = take.landmarks.values.double()
    filtered, smoothed = filter_landmarks(values), smooth_landmarks(values)
    for found in (filtered, smoothed):
        assert float((found - values).norm(dim=-1).mean()) < 0.3
        assert float(found.diff(n=2, dim=0).norm(dim=-1).mean()) < 0.7 * float(
            values.diff(n=2, dim=0).norm(dim=-1).mean()
        )
