"""A video solver is its state and its config: saved, moved and loaded, it gives what it gave."""

import math

import pytest
import torch
from torch import Tensor

from torchface.capture.own_rig import VideoSettings, VideoSolver
from torchface.capture.priors import DynamicsPrior, DynamicsSettings, ShapePrior
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.onnx.video_graph_export import synthetic_landmarks
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)
NAMES = ("jawOpen", "mouthPucker", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "eyeBlinkLeft", "mouthLeft")


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False).select(NAMES)


@pytest.fixture(scope="module")
def takes(rig: BlendshapeRig) -> list[Tensor]:
    return [synthetic_landmarks(VideoSolver(rig, None, K), 60, seed)[0] for seed in (1, 2)]


@pytest.fixture(scope="module")
def solver(rig: BlendshapeRig, takes: list[Tensor]) -> VideoSolver:
    """With both priors."""
    pytest.importorskip("gpytorch")
    quick = DynamicsSettings(inducing=10, subset=60, iterations=3)
    dynamics = DynamicsPrior.fit(takes, NAMES, window=3, settings=quick)
    return VideoSolver(rig, None, K, ShapePrior.fit(takes, NAMES), dynamics, VideoSettings(relative_noise=0.01))


@pytest.fixture(scope="module")
def landmarks(solver: VideoSolver) -> Tensor:
    return synthetic_landmarks(solver, 6)[1]


def weights(solver: VideoSolver, landmarks: Tensor) -> Tensor:
    with torch.no_grad():
        return solver(landmarks).weights


def test_all_that_it_computes_with_is_in_its_state(solver: VideoSolver, landmarks: Tensor) -> None:
    """A module of NaN with the same config becomes the solver by its state alone."""
    ours = VideoSolver.from_config(solver.config)
    saved = dict(ours.named_buffers()).keys() & solver.state_dict().keys()
    with torch.no_grad():
        for name, buffer in ours.named_buffers():
            if name in saved and buffer.is_floating_point():
                buffer.fill_(math.nan)
    ours.load_state_dict(solver.state_dict())
    assert torch.equal(weights(ours, landmarks), weights(solver, landmarks))
    assert all(value is None or not isinstance(value, Tensor) for value in vars(ours).values())


def test_states_that_no_rig_gives_are_refused(solver: VideoSolver) -> None:
    broken = VideoSolver.from_config(solver.config)
    broken.load_state_dict(solver.state_dict())
    broken.rows[3, 0] = len(broken.rest)
    with pytest.raises(ValueRangeError, match="rows beyond"):
        broken.check_state()
    with pytest.raises(RuntimeError, match="size mismatch"):
        broken.load_state_dict({**solver.state_dict(), "basis": solver.basis[..., :3]})
    unknown = VideoSolver.from_config({**solver.config, "prior": None})
    unknown.prior = torch.nn.Identity()
    with pytest.raises(NameMismatchError, match="prior of class Identity"):
        _ = unknown.config
