"""Whole takes: the first frames may lack a face, progress is reported, uneven frames are solved at even times."""

import pytest
import torch
from torch import Tensor

from torchface.capture.own_rig import VideoSettings, VideoSolver
from torchface.capture.own_rig.take_solve import solve_take
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)
FRAMES = 6


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False).select(["jawOpen", "mouthPucker", "browInnerUp"])


@pytest.fixture(scope="module")
def landmarks(rig: BlendshapeRig) -> Tensor:
    """Of a jaw that opens, (T,68,2)."""
    weights = torch.zeros(FRAMES, 3)
    weights[:, 0] = torch.linspace(0, 0.8, FRAMES)
    rotation = rotation_matrix(torch.tensor([torch.pi, 0.0, 0.0]).double())
    points = rig(weights)[:, rig.neutral.landmarks].double() @ rotation.T + torch.tensor([0.0, 0, 480]).double()
    image = points @ K.T
    return image[..., :2] / image[..., 2:]


@pytest.mark.parametrize("whole_take", [False, True])
def test_only_the_first_frames_lack_trusted_landmarks(rig: BlendshapeRig, landmarks: Tensor, whole_take: bool) -> None:
    """Six finite ones of which five are trusted are no face; they have the state of the first frame that shows one."""
    trust = torch.ones(FRAMES, 68)
    trust[:2, 5:] = 0
    seen = landmarks.clone()
    seen[:2, 6:] = torch.nan
    steps: list[tuple[str, int, int]] = []
    solver = VideoSolver(rig, None, K, settings=VideoSettings.of_found_landmarks())
    solution = solve_take(solver, seen, trust, None, whole_take, lambda *step: steps.append(step))
    assert solution.solved.tolist() == [False, False, True, True, True, True]
    assert torch.equal(solution.weights[:2], solution.weights[2:3].expand(2, -1))
    assert torch.equal(solution.weights[2:], solver(landmarks[2:]).weights)
    assert steps == [("solving for weights", frame, FRAMES) for frame in range(3, FRAMES + 1)]


def test_frames_without_a_face_lie_between_their_neighbours_in_a_whole_take(
    rig: BlendshapeRig, landmarks: Tensor
) -> None:
    """By the frames' times, where these are given."""
    trust = torch.ones(FRAMES, 68)
    trust[2:4] = 0
    solver = VideoSolver(rig, None, K, settings=VideoSettings.of_found_landmarks())
    seconds = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.6, 0.7], dtype=torch.float64)
    live, whole = (solve_take(solver, landmarks, trust, seconds, each) for each in (False, True))
    assert torch.equal(whole.weights[[0, 1, 4, 5]], live.weights[[0, 1, 4, 5]])
    shares = torch.tensor([0.2, 0.4], dtype=torch.float64)[:, None]
    torch.testing.assert_close(whole.weights[2:4], torch.lerp(live.weights[1:2], live.weights[4:5], shares))


def test_takes_that_cannot_be_solved_are_refused(rig: BlendshapeRig, landmarks: Tensor) -> None:
    solver = VideoSolver(rig, None, K)
    with pytest.raises(ValueRangeError, match="found at most 0 that are trusted in any of 6 frames, expected at least"):
        solve_take(solver, landmarks, torch.zeros(FRAMES, 68))
    with pytest.raises(ShapeError, match=r"seconds: found \(2,\), expected \(6,\)"):
        solve_take(solver, landmarks, torch.ones(FRAMES, 68), torch.arange(2.0))
