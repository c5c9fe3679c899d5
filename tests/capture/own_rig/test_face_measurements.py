"""Measurements beside landmarks: what readings of weights and deviations add to a solve."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface.capture.own_rig import CameraView, FaceMeasurements, VideoSettings, VideoSolver
from torchface.capture.weight_readings import WeightReadings
from torchface.errors import ShapeError
from torchface.geometry.rotations import rotation_matrix
from torchface.synthetic import performer

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)
NAMES = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "noseSneerLeft", "noseSneerRight", "cheekPuff", "mouthLeft")
FRAMES = 4


def poses() -> Tensor:
    angles = torch.linspace(-0.2, 0.3, FRAMES, dtype=torch.float64)[:, None] * torch.tensor([0.3, 1.0, 0.1]).double()
    return torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64)) @ rotation_matrix(angles)


def film(noise: float) -> tuple[VideoSolver, Tensor, Tensor]:
    """A solver that reckons with a noise, weights (T,7), and landmarks as they project."""
    settings = VideoSettings(pixel_noise=noise, contour_slide=1.0, sparsity=0.0, ridge=1e-6)
    solver = VideoSolver(performer(texture=False).select(NAMES), None, K, settings=settings)
    weights = 0.6 * torch.rand(FRAMES, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    placed = solver.points.at(weights)[:, :68] @ poses().mT + torch.tensor([5.0, -3.0, 500.0]).double()
    image = placed @ K.T
    return solver, weights, image[..., :2] / image[..., 2:]


def test_readings_of_nothing_leave_the_solve_as_it_is() -> None:
    solver, _, landmarks = film(0.05)
    nothing = torch.full((FRAMES, 52), torch.nan), torch.full((FRAMES, 52), torch.inf)
    measured = FaceMeasurements(weights=WeightReadings.of_expression(*nothing, NAMES))
    assert torch.equal(solver(landmarks, measured=measured).weights, solver(landmarks).weights)


def test_readings_decide_what_landmarks_do_not_show() -> None:
    solver, weights, landmarks = film(20.0)
    read = WeightReadings(torch.eye(7), weights, torch.full((FRAMES, 7), 0.01))
    found = solver(landmarks, measured=FaceMeasurements(weights=read)).weights
    assert float((found - weights).abs().max()) < 0.02


def test_landmarks_count_by_their_own_deviations() -> None:
    """The lips are wrong, and known to be: the jaw's shape follows the chin."""
    solver, weights, landmarks = film(0.05)
    landmarks[:, 48:] += 8.0 * torch.randn(20, 2, generator=torch.Generator().manual_seed(1)).double()
    deviation = torch.full((FRAMES, 68), 0.1)
    deviation[:, 48:] = 8.0
    known, unknown = (
        float((solver(landmarks, measured=one).weights - weights)[:, 0].abs().mean())
        for one in (FaceMeasurements(deviation), FaceMeasurements())
    )
    assert known < 0.3 * unknown
    with pytest.raises(ShapeError, match=r"measured deviation: found \(1, 5\), expected \(1, 68\)"):
        solver(landmarks, measured=FaceMeasurements(deviation[:, :5]))


def other_camera(solver: VideoSolver, weights: Tensor, noise: float = 0.0) -> CameraView:
    """A camera 300 mm to the right that is turned toward the face of ``film``, and what it saw."""
    turn = rotation_matrix(torch.tensor([[0.0, 0.55, 0.02]], dtype=torch.float64))[0]
    place = -turn @ torch.tensor([300.0, 10.0, 60.0]).double()
    other = torch.tensor([[500.0, 0, 310.0], [0, 520.0, 250.0], [0, 0, 1]], dtype=torch.float64)
    points = solver.points.at(weights)[:, :68] @ poses().mT + torch.tensor([5.0, -3.0, 500.0]).double()
    image = (points @ turn.T + place) @ other.T
    pixels = image[..., :2] / image[..., 2:]
    pixels = pixels + noise * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(5)).double()
    return CameraView(pixels, torch.zeros(FRAMES, 68), other, turn, place)


def test_two_cameras_find_what_was_planted_and_one_that_sees_nothing_changes_nothing() -> None:
    solver, weights, landmarks = film(0.01)
    view = other_camera(solver, weights)
    found = solver(landmarks, measured=FaceMeasurements(views=(view,)))
    torch.testing.assert_close(found.weights, weights, atol=1e-3, rtol=0)
    torch.testing.assert_close(found.rotation, poses(), atol=1e-4, rtol=0)
    blind = replace(view, deviation=torch.full((FRAMES, 68), torch.inf))
    assert torch.equal(solver(landmarks, measured=FaceMeasurements(views=(blind,))).weights, solver(landmarks).weights)


def test_the_second_camera_shows_what_the_first_does_not() -> None:
    """The first sees nothing in frames 0 and 2: the second alone gives pose and weights. Two find more in noise."""
    solver, weights, landmarks = film(0.01)
    hidden = landmarks.clone()
    hidden[[0, 2]] = torch.nan
    found = solver(hidden, measured=FaceMeasurements(views=(other_camera(solver, weights),)))
    assert bool(found.solved.all())
    torch.testing.assert_close(found.weights, weights, atol=1e-3, rtol=0)
    solver, weights, landmarks = film(1.0)
    noisy = landmarks + torch.randn(landmarks.shape, generator=torch.Generator().manual_seed(4)).double()
    views = (other_camera(solver, weights, 1.0),)
    both, one = solver(noisy, measured=FaceMeasurements(views=views)), solver(noisy)
    assert float((both.weights - weights).square().mean()) < 0.75 * float((one.weights - weights).square().mean())
    depth = [float((x.translation[:, 2] - 500).abs().mean()) for x in (both, one)]
    assert depth[0] < 0.5 * depth[1]
    with pytest.raises(ShapeError, match=r"landmarks \(4, 5, 2\), expected \(4, 68, 2\)"):
        replace(views[0], landmarks=views[0].landmarks[:, :5])


def test_single_frames_are_solved_as_batches_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """NumPy's steps of one frame against PyTorch's: sliding contour, motion, readings, an antagonist, a hidden part."""
    rig = performer(texture=False).select([*NAMES, "mouthRight"])
    solver = VideoSolver(rig, None, K, settings=VideoSettings.of_found_landmarks())
    generator = torch.Generator().manual_seed(2)
    weights = 0.6 * torch.rand(FRAMES, 8, generator=generator).double()
    image = (solver.points.at(weights)[:, :68] @ poses().mT + torch.tensor([5.0, -3.0, 500.0]).double()) @ K.T
    landmarks = image[..., :2] / image[..., 2:] + torch.randn(FRAMES, 68, 2, generator=generator)
    landmarks[2, 20:30] = torch.nan
    read = WeightReadings(torch.eye(8), weights, torch.full((FRAMES, 8), 0.2))
    measured = FaceMeasurements(torch.ones(FRAMES, 68), read)
    one = solver(landmarks, measured=measured)
    monkeypatch.setattr(VideoSolver, "_simple", lambda *_: False)
    other = solver(landmarks, measured=measured)
    for name in ("weights", "rotation", "translation"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), atol=1e-8, rtol=1e-8)
