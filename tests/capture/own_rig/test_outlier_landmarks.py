"""Landmarks that no face has where they are, are found; those of faces that move are not."""

import pytest
import torch
from torch import Tensor

from torchface.capture.own_rig.outlier_landmarks import landmark_reach, outlier_landmarks
from torchface.errors import ShapeError
from torchface.geometry.rotations import rotation_matrix
from torchface.synthetic.head.performer import performer

FRAMES, FPS = 60, 30.0


@pytest.fixture(scope="module")
def face() -> tuple[Tensor, Tensor, Tensor]:
    """A rig's landmarks and their reach, and the pixels (T,68,2) of a face that turns far, speaks and blinks."""
    rig = performer(texture=False)
    rest, reach = landmark_reach(rig)
    t = torch.linspace(0, 1, FRAMES)
    weights = torch.zeros(FRAMES, len(rig.names))
    for name, times in (("jawOpen", 4.0), ("mouthPucker", 3.0), ("mouthSmileLeft", 1.0), ("browInnerUp", 2.0)):
        weights[:, rig.names.index(name)] = (6.28 * times * t).sin().clamp(0, 1)
    for name in ("eyeBlinkLeft", "eyeBlinkRight"):
        weights[30:33, rig.names.index(name)] = 1.0
    turn = torch.stack([0.2 * (9 * t).sin(), 0.8 * (6.28 * t).sin(), 0.1 * t], 1).double()
    points = (rig(weights)[:, rig.neutral.landmarks].double() - rest.mean(0)) @ rotation_matrix(turn).mT
    depth = 600 - points[..., 2:]
    return rest, reach, points[..., :2] / depth * torch.tensor([900.0, -900.0]) + 320


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("pixels", [60.0, 300.0, 20_000.0])
def test_outliers_are_found_and_nothing_else_is(face: tuple[Tensor, Tensor, Tensor], seed: int, pixels: float) -> None:
    rest, reach, clean = face
    generator = torch.Generator().manual_seed(seed)
    noisy = clean + 0.5 * torch.randn(clean.shape, generator=generator)
    planted = torch.zeros(FRAMES, 68, dtype=torch.bool)
    for frame in torch.randperm(FRAMES // 4, generator=generator)[:6].tolist():
        planted[4 * frame, torch.randperm(68, generator=generator)[:15]] = True
    turn = 6.28 * torch.rand(FRAMES, 68, generator=generator)
    noisy = noisy + planted[..., None] * pixels * torch.stack([turn.cos(), turn.sin()], -1)
    found = outlier_landmarks(rest, reach, noisy, torch.ones(FRAMES, 68), FPS)
    assert torch.equal(found, planted)


def test_frames_are_judged_alone_where_there_is_no_rate(face: tuple[Tensor, Tensor, Tensor]) -> None:
    rest, reach, clean = face
    trust = torch.ones(FRAMES, 68)
    assert not outlier_landmarks(rest, reach, clean, trust).any()
    wild = clean.clone()
    wild[20, [5, 40, 60]] = torch.tensor([-900.0, 4000.0], dtype=torch.float64)
    assert outlier_landmarks(rest, reach, wild, trust).nonzero().tolist() == [[20, 5], [20, 40], [20, 60]]
    trust[20, 40] = 0.0  # what nobody trusts is not judged
    wild[20, 60] = torch.nan
    assert outlier_landmarks(rest, reach, wild, trust).nonzero().tolist() == [[20, 5]]
    trust[20, 7:] = 0.0
    assert not outlier_landmarks(rest, reach, wild, trust).any()  # of seven landmarks none can be judged
    with pytest.raises(ShapeError, match="outlier landmarks: found rest"):
        outlier_landmarks(rest, reach, wild[:, :5], trust)
