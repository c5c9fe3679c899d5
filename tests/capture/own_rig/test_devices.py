"""What is given on a device is computed on it: no function on the way makes tensors elsewhere.

Most machines that run tests have one device; see ``pretended_device`` for the second.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from pretended_device import pretended
from torch import Tensor
from torch.utils._pytree import tree_leaves

from torchface.capture.own_rig import VideoSettings, VideoSolver, solve_whole_take
from torchface.capture.own_rig.head_pose import measure_poses
from torchface.capture.priors import ShapePrior
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import undistort
from torchface.geometry.cameras.pnp import solve_pnp
from torchface.geometry.cameras.robust_pnp import robust_pnp
from torchface.geometry.rotations import rotation_matrix
from torchface.onnx.video_graph_export import synthetic_landmarks
from torchface.synthetic import performer
from torchface.temporal import (
    AdaptiveFilter,
    KalmanFilter,
    KalmanSettings,
    adaptive_filter,
    adaptive_smoother,
    kalman_smoother,
)

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)


@contextlib.contextmanager
def real() -> Iterator[str]:
    yield "cuda"


@pytest.fixture(params=["pretended", "cuda"])
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU")
    if request.param == "pretended":
        # Tensors of a class of one's own cannot be looked at in inference mode.
        request.getfixturevalue("monkeypatch").setattr(torch, "inference_mode", torch.no_grad)
    with pretended() if request.param == "pretended" else real() as name:
        yield name


def moved(x: Any, device: str) -> Any:
    return x.to(device) if isinstance(x, Tensor) else x


def check(compute: Callable[..., Any], device: str, *given: Any) -> None:
    """What a function computes on the CPU it computes on the device, and leaves there."""
    expected = tree_leaves(compute(*given))
    found = tree_leaves(compute(*(moved(x, device) for x in given)))
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert one.device.type == device
        torch.testing.assert_close(one.cpu(), other, equal_nan=True, rtol=1e-6, atol=1e-6)


@pytest.fixture(scope="module")
def seen() -> tuple[Tensor, Tensor]:
    """The performer's landmarks at rest (68,3), and in a film in which the head turns (T,68,2); some are not seen."""
    rig = performer(texture=False)
    points = rig.vertices[rig.neutral.landmarks].double()
    at = torch.linspace(0, 1, 7, dtype=torch.float64)[:, None]
    turn = torch.cat([0.1 * torch.sin(3 * at), 0.25 * torch.cos(2 * at), 0.05 * at], dim=1)
    rotation = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64)) @ rotation_matrix(turn)
    image = (points @ rotation.mT + torch.tensor([0.0, 0, 480]).double()) @ K.T
    pixels = image[..., :2] / image[..., 2:]
    pixels = pixels + 0.3 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1)).double()
    pixels[3] = torch.nan
    pixels[5, 30:40] = torch.nan
    return points, pixels


def test_the_pretended_device_is_one() -> None:
    """It refuses what a GPU refuses, and computes what the CPU does."""
    with pretended() as device:
        away = torch.tensor([1.0, 2, 3], device=device)
        for ours in (torch.zeros(3), torch.arange(3)):
            with pytest.raises(RuntimeError, match="same device"):
                _ = away + ours
        assert (away + away.new_ones(3) + 1.0).tolist() == [3, 4, 5]
        away[away > 1] = 7.0
        away[[0]] = away.new_tensor([5.0])
        assert away.cpu().tolist() == [5, 7, 7]
        assert bool((away > 6).any())


@pytest.mark.bench  # the robust one begins with it
def test_pnp(seen: tuple[Tensor, Tensor], device: str) -> None:
    points, pixels = seen
    pixels = pixels[:2]
    flat = points * torch.tensor([1.0, 1, 0]).double()

    def poses(points: Tensor, pixels: Tensor, intrinsics: Tensor) -> Any:
        return list(vars(solve_pnp(points, pixels, intrinsics)).values())

    for x in (points, flat):
        check(poses, device, x, pixels, K)


def test_robust_pnp(seen: tuple[Tensor, Tensor], device: str) -> None:
    points, pixels = seen
    pixels = pixels.clone()
    pixels[:, ::5] += 60.0

    def poses(points: Tensor, pixels: Tensor, intrinsics: Tensor, threshold: Tensor) -> Any:
        found = robust_pnp(points, pixels, intrinsics, threshold)
        return [*vars(found.pose).values(), found.inliers]

    check(poses, device, points, pixels, K, torch.full((7,), 4.0))


def test_head_poses(seen: tuple[Tensor, Tensor], device: str) -> None:
    check(lambda *given: list(vars(measure_poses(*given)).values()), device, *seen, K)


def test_filters_along_time(seen: tuple[Tensor, Tensor], device: str) -> None:
    landmarks = seen[1][:, 25:33]
    settings = KalmanSettings(0.5, 0.1)
    for filtered in (adaptive_filter, adaptive_smoother):
        check(filtered, device, landmarks)
    check(lambda x: kalman_smoother(x, settings), device, landmarks)


def test_running_filters_follow_what_they_are_given(seen: tuple[Tensor, Tensor], device: str) -> None:
    """A filter that began on the CPU goes on elsewhere."""
    frames = seen[1]
    for make in (lambda: AdaptiveFilter(68, 2), lambda: KalmanFilter(68, KalmanSettings(0.5, 0.1))):
        some = (lambda x: x) if isinstance(make(), AdaptiveFilter) else (lambda x: x[:, 0])
        ours, other = make(), make()
        for t, frame in enumerate(frames):
            expected = ours.step(some(frame))
            found = other.step(some(frame.to(device) if t > 1 else frame))
            torch.testing.assert_close(found.cpu(), expected, equal_nan=True, rtol=1e-9, atol=1e-9)


def test_landmarks_of_a_lens_that_bends(seen: tuple[Tensor, Tensor], device: str) -> None:
    bent = CameraCalibration(K, torch.tensor([0.1, -0.02, 0.001, 0.001, 0.0]).double(), 640, 480)
    check(lambda pixels: undistort(pixels, bent), device, seen[1])


@pytest.mark.bench  # tests/modules moves the solver of videos too
def test_the_solver_and_all_it_holds(device: str) -> None:
    """Moved as a whole, also after it was used, with a prior and a memory; frame by frame and the whole take."""
    names = ("jawOpen", "mouthSmileLeft", "browInnerUp")
    takes = torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    solver = VideoSolver(
        performer(texture=False).select(names),
        None,
        K,
        ShapePrior.fit([takes], names),
        Walk(),
        VideoSettings(relative_noise=0.01),
    )
    landmarks = synthetic_landmarks(solver, 4)[1].double()
    landmarks[2] = torch.nan
    expected = [solver(landmarks), solve_whole_take(solver, landmarks)]
    solver.to(device)
    assert {tensor.device.type for tensor in (*solver.buffers(), *solver.parameters())} == {device}
    away = landmarks.to(device)
    with torch.no_grad():
        for one, other in zip((solver(away), solve_whole_take(solver, away)), expected, strict=True):
            for found, known in zip(vars(one).values(), vars(other).values(), strict=True):
                assert found.device.type == device
                torch.testing.assert_close(found.cpu(), known, equal_nan=True, rtol=1e-6, atol=1e-6)


class Walk(torch.nn.Module):
    """Weights stay where they are, give or take a little: a dynamics prior that needs no learning."""

    window = 1

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(3, dtype=torch.float64))

    def require(self, names: tuple[str, ...]) -> None:
        assert len(names) == 3

    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        return 0.999 * windows[:, -1], 1e-3 * torch.ones_like(windows[:, -1])
