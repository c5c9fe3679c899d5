"""The same performance filmed at any rate, even or not, gives the same weights at the same times."""

import pytest
import torch
from torch import Tensor

from torchface.capture.own_rig import VideoSettings, VideoSolver
from torchface.capture.own_rig.take_solve import even_times, rotations_at
from torchface.capture.own_rig.weight_walk import frame_intervals
from torchface.errors import ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer
from torchface.temporal.adaptive_kalman import LANDMARK_SETTINGS, adaptive_filter
from torchface.temporal.interpolation import values_at

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)
SHAPES = ("jawOpen", "mouthPucker", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "eyeBlinkLeft", "mouthLeft")
SETTLED = 0.3  # seconds, after which filters know how the face moves


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False).select(SHAPES)


def performed(seconds: Tensor) -> Tensor:
    """Weights (T,7) at times."""
    phases = torch.arange(len(SHAPES), dtype=torch.float64)
    return 0.5 + 0.3 * torch.sin(2 * torch.pi * (0.4 + 0.1 * phases) * seconds[:, None] + phases)


def filmed(rig: BlendshapeRig, seconds: Tensor) -> Tensor:
    """Landmarks (T,68,2) at times, while the head turns."""
    turn = torch.stack([0.1 * torch.sin(3 * seconds), 0.2 * torch.cos(2 * seconds), 0.05 * seconds], dim=1)
    rotation = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64)) @ rotation_matrix(turn)
    points = rig(performed(seconds).float())[:, rig.neutral.landmarks].double() @ rotation.transpose(1, 2)
    image = (points + torch.tensor([5.0, -5, 480], dtype=torch.float64)) @ K.T
    return image[..., :2] / image[..., 2:]


def solved(rig: BlendshapeRig, seconds: Tensor) -> Tensor:
    """Weights as a video whose frames are shown then gives them, filtered live."""
    fps = float((len(seconds) - 1) / seconds[-1])
    intervals = [fps * step for step in frame_intervals(seconds, len(seconds), 1 / fps)]
    landmarks = adaptive_filter(filmed(rig, seconds), LANDMARK_SETTINGS, intervals)
    solver = VideoSolver(rig, None, K, settings=VideoSettings.of_found_landmarks(fps=fps))
    return solver(landmarks, seconds=seconds).weights.double()


@pytest.fixture(scope="module")
def at_sixty(rig: BlendshapeRig) -> Tensor:
    return solved(rig, torch.arange(61, dtype=torch.float64) / 60)


@pytest.mark.parametrize("fps", [15, 120])
def test_other_rates_give_the_same(rig: BlendshapeRig, at_sixty: Tensor, fps: int) -> None:
    seconds = torch.arange(fps + 1, dtype=torch.float64) / fps
    common = seconds[seconds >= SETTLED] if fps < 60 else torch.arange(18, 61, dtype=torch.float64) / 60
    found = solved(rig, seconds)[(common * fps).round().long()]
    assert float((found - at_sixty[(common * 60).round().long()]).abs().max()) < 0.03


def test_uneven_times_give_what_even_ones_do(rig: BlendshapeRig) -> None:
    """Frames of 33 ms, of 17, of 67 and a hole of 133, at times that an even film has too."""
    ticks = torch.tensor(
        [0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 19, 20, 21, 22, 24, 28, 32, 36, 38, 46, 48, 50, 52, 56, 60]
    )
    even = solved(rig, torch.arange(31, dtype=torch.float64) / 30)
    uneven = solved(rig, ticks.double() / 60)
    common = (ticks % 2 == 0) & (ticks >= 60 * SETTLED)
    assert float((uneven[common] - even[ticks[common] // 2]).abs().max()) < 0.03


def test_frames_are_brought_to_an_even_rate_and_back() -> None:
    seconds = torch.tensor([0.0, 0.1, 0.15, 0.4, 0.5], dtype=torch.float64)
    even = even_times(seconds)
    torch.testing.assert_close(even, torch.linspace(0, 0.5, 5, dtype=torch.float64))
    line = torch.stack([3 * seconds - 1, 2 - seconds], dim=1)
    there = values_at(line, seconds, even)
    torch.testing.assert_close(there, torch.stack([3 * even - 1, 2 - even], dim=1))
    torch.testing.assert_close(values_at(there, even, seconds), line)
    lost = line.clone()
    lost[3] = torch.nan
    assert values_at(lost, seconds, even)[:, 0].isnan().tolist() == [False, False, True, True, False]
    axis = torch.tensor([0.3, -0.5, 0.2], dtype=torch.float64)
    turns = rotation_matrix(seconds[:, None] * axis)
    torch.testing.assert_close(rotations_at(turns, seconds, even), rotation_matrix(even[:, None] * axis))
    with pytest.raises(ValueRangeError, match="expected times that rise"):
        frame_intervals(seconds[[0, 1, 1]], 3, 1 / 30)
