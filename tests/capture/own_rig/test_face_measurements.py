"""Measurements beside landmarks: what readings of weights and deviations add to a solve."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchface.capture.own_rig import FaceMeasurements, VideoSettings, VideoSolver
from torchface.capture.weight_readings import WeightReadings
from torchface.errors import ShapeError
from torchface.geometry.rotations import rotation_matrix
from torchface.synthetic import performer

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)
NAMES = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "noseSneerLeft", "noseSneerRight", "cheekPuff", "mouthLeft")
FRAMES = 4


def film(noise: float) -> tuple[VideoSolver, Tensor, Tensor]:
    """A solver that reckons with a noise, weights (T,7), and landmarks as they project."""
    settings = VideoSettings(pixel_noise=noise, contour_slide=1.0, sparsity=0.0, ridge=1e-6)
    solver = VideoSolver(performer(texture=False).select(NAMES), None, K, settings=settings)
    weights = 0.6 * torch.rand(FRAMES, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    angles = torch.linspace(-0.2, 0.3, FRAMES, dtype=torch.float64)[:, None] * torch.tensor([0.3, 1.0, 0.1]).double()
    rotation = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64)) @ rotation_matrix(angles)
    placed = solver.points.at(weights)[:, :68] @ rotation.mT + torch.tensor([5.0, -3.0, 500.0]).double()
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
