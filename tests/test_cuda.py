"""Modules run on a GPU unchanged: moved there, they give what they give on the CPU."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from torchface import zoo
from torchface.capture import DynamicsPrior, HelmetSolver, HybridSolver, MarkerSolver, ShapePrior, VideoSolver
from torchface.capture.own_rig import solve_whole_take
from torchface.capture.own_rig.head_pose import measure_poses
from torchface.capture.priors import adapt_dynamics
from torchface.geometry.cameras.robust_pnp import robust_pnp
from torchface.optim import BoxQP
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer
from torchface.synthetic.stages.marker_stage import place_markers
from torchface.temporal.adaptive_kalman import LANDMARK_SETTINGS, AdaptiveFilter, adaptive_smoother

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU that torch sees")

Inputs = tuple[Tensor, ...]


def uniform(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def tensors_of(result: Any) -> list[Tensor]:
    """All tensors of a result: one, a tuple of them, or a dataclass."""
    if isinstance(result, Tensor):
        return [result]
    parts = result if isinstance(result, tuple | list) else vars(result).values() if hasattr(result, "__dict__") else ()
    return [tensor for part in parts for tensor in tensors_of(part)]


def assert_same_on_both(
    module: nn.Module, inputs: Inputs, tolerance: float, call: Callable[..., Any] | None = None
) -> None:
    call = call or (lambda module, *given: module(*given))
    wanted = tensors_of(call(module, *inputs))
    module = module.to("cuda")
    found = tensors_of(call(module, *(tensor.cuda() for tensor in inputs)))
    assert len(found) == len(wanted)
    assert wanted
    for here, there in zip(wanted, found, strict=True):
        assert there.is_cuda
        torch.testing.assert_close(there.cpu(), here, rtol=tolerance, atol=tolerance, equal_nan=True)
    module.to("cpu")


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False)


@pytest.fixture(scope="module")
def markers(rig: BlendshapeRig) -> Tensor:
    weights = uniform(12, len(rig.names)) * (uniform(12, len(rig.names), seed=1) > 0.7)
    seen = place_markers(rig, 80).on(rig.neutral.faces, rig(weights))
    seen[6:] = torch.where(uniform(6, 80, 1, seed=2) < 0.2, torch.nan, seen[6:])
    return seen


def test_the_box_qp() -> None:
    A = uniform(40, 20, dtype=torch.float64)
    assert_same_on_both(BoxQP(A.T @ A), (uniform(50, 20, seed=1, dtype=torch.float64) - 0.5,), 1e-9)
    assert_same_on_both(BoxQP(nn.Parameter((A.T @ A).float())), (uniform(50, 20, seed=1) - 0.5,), 1e-4)


def test_a_rig(rig: BlendshapeRig) -> None:
    assert_same_on_both(rig, (uniform(5, len(rig.names)),), 1e-3)


def test_marker_solvers(rig: BlendshapeRig, markers: Tensor) -> None:
    solver = MarkerSolver(rig, place_markers(rig, 80))
    pull = uniform(12, len(rig.names), seed=3)
    assert_same_on_both(solver, (markers.double(),), 1e-6)
    assert_same_on_both(HelmetSolver(rig, place_markers(rig, 80)), (markers.double(),), 1e-5)
    assert_same_on_both(HybridSolver(solver), (markers.double(), pull.double(), 2 * pull.double()), 1e-6)


def portraits(rig: BlendshapeRig, frames: int = 8) -> tuple[Tensor, Tensor]:
    """Landmarks (T,68,2) of one camera, and its intrinsics."""
    at = torch.linspace(0, 1, frames, dtype=torch.float64)
    weights = (0.3 + 0.3 * torch.sin(3 * at[:, None] + torch.arange(len(rig.names)))) * 0.5
    points = rig.double()(weights)[:, rig.neutral.landmarks]
    rig.float()
    intrinsics = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)
    placed = points * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64) + torch.tensor([0.0, 0.0, 480.0]).double()
    image = placed @ intrinsics.T
    noise = torch.randn(frames, 68, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return image[..., :2] / image[..., 2:] + 0.3 * noise, intrinsics


def test_the_video_solver_with_priors(rig: BlendshapeRig) -> None:
    landmarks, intrinsics = portraits(rig)
    prior: ShapePrior = zoo.get_model("shape_prior").renamed(rig.names)
    dynamics: DynamicsPrior = zoo.get_model("dynamics_prior")
    assert_same_on_both(VideoSolver(rig, None, intrinsics), (landmarks,), 1e-3)
    solver = VideoSolver(rig, None, intrinsics, prior, adapt_dynamics(dynamics, rig.names, 30.0))
    assert_same_on_both(solver, (landmarks,), 1e-3)
    assert_same_on_both(solver, (landmarks,), 1e-3, solve_whole_take)


def test_head_poses_and_filters(rig: BlendshapeRig) -> None:
    landmarks, intrinsics = portraits(rig)
    points = rig.vertices[rig.neutral.landmarks].double()
    here = tensors_of(measure_poses(points, landmarks, intrinsics))
    there = tensors_of(measure_poses(points.cuda(), landmarks.cuda(), intrinsics.cuda()))
    for a, b in zip(here, there, strict=True):
        torch.testing.assert_close(b.cpu(), a, rtol=1e-4, atol=1e-4)
    found = tensors_of(robust_pnp(points[17:48].cuda(), landmarks[:, 17:48].cuda(), intrinsics.cuda()))
    wanted = tensors_of(robust_pnp(points[17:48], landmarks[:, 17:48], intrinsics))
    for a, b in zip(wanted, found, strict=True):
        torch.testing.assert_close(b.cpu().double(), a.double(), rtol=1e-4, atol=1e-4)
    smooth = adaptive_smoother(landmarks.cuda())
    torch.testing.assert_close(smooth.cpu(), adaptive_smoother(landmarks), rtol=1e-6, atol=1e-6)
    calm, calmed = (AdaptiveFilter(68, 2, LANDMARK_SETTINGS) for _ in range(2))
    for frame in landmarks:  # filters go frame by frame
        a, b = calm.step(frame), calmed.step(frame.cuda())
        torch.testing.assert_close(b.cpu(), a, rtol=1e-6, atol=1e-6)


def test_models_lie_where_they_were_asked_for() -> None:
    for name in zoo.list_models():
        model = zoo.get_model(name, device="cuda")
        assert {tensor.device.type for tensor in model.state_dict().values()} == {"cuda"}, name


@pytest.mark.parametrize("name", ["expressions", "face_landmarks", "head", "uv_landmarks"])
def test_models_of_the_zoo(rig: BlendshapeRig, name: str) -> None:
    model = zoo.get_model(name)
    if name == "face_landmarks":
        box = torch.tensor([[20.0, 20.0, 100.0, 100.0]]).expand(3, 4)
        inputs: Inputs = (uniform(3, 1, 128, 128), box)
    elif name == "uv_landmarks":
        inputs = (uniform(1, 3, model.size, model.size),)
    elif name == "head":
        inputs = (uniform(3, len(model.shape.components)),)
    else:
        inputs = (rig.vertices[None] + uniform(2, 1, 3),)
    assert_same_on_both(model, inputs, 1e-3)
