"""Further points of people's surfaces in the webcam's solve: what landmarks say of them, and what they add."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import Attachment, zoo
from torchface.capture.anybody import WebcamSettings, WebcamSolver
from torchface.capture.anybody.person_surface import PersonSurface
from torchface.geometry.rotations import rotation_matrix
from torchface.landmarks.images.face_reading import FaceReading
from torchface.shape_names import ARKIT
from torchface.synthetic import performer

COUNT = 120
FOCAL = 554.256
UPRIGHT = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


@pytest.fixture(scope="module")
def solver() -> WebcamSolver:
    rig, heads = performer(texture=False), zoo.get_model("head")
    place = rig.vertices
    front = ((place[:, 2] > 40) & (place[:, 1].abs() < 80)).nonzero()[:, 0]
    sites = Attachment.from_vertices(rig.neutral, front[torch.linspace(0, len(front) - 1, COUNT).long()])
    modes = heads.shape.modes
    both = torch.cat([modes[:, heads.landmarks], sites.on(rig.neutral.faces, modes)], dim=1)
    settings = WebcamSettings(coefficients=40, noise=0.004, sparsity=0.1)
    return WebcamSolver(rig, both, settings=settings, surface=sites)


def surface_of(solver: WebcamSolver) -> PersonSurface:
    assert solver.surface is not None
    return solver.surface


def reading(solver: WebcamSolver, weights: Tensor, noise: float, seed: int = 0) -> FaceReading:
    """The rig's own person: noisy landmarks, exact points."""
    own = (weights @ solver.to_arkit)[None]
    nobody = torch.zeros(solver.settings.coefficients, dtype=torch.float64)
    rotation = (UPRIGHT @ rotation_matrix(torch.tensor([0.05, 0.2, 0.0], dtype=torch.float64)))[None]
    translation = torch.tensor([[10.0, 30.0, 620.0]], dtype=torch.float64)

    def pixels(placed: Tensor) -> Tensor:
        there = placed @ rotation[0].T + translation
        return there[:, :2] / there[:, 2:] * FOCAL + torch.tensor([319.5, 239.5])

    points = solver.person.points(nobody)
    rows = points.chosen(own, rotation, translation, torch.eye(3, dtype=torch.float64))
    marks = pixels(points.at(own)[0, rows[0]])
    marks = marks + noise * torch.randn(marks.shape, generator=torch.Generator().manual_seed(seed))
    surface = surface_of(solver).points(nobody)
    dense = pixels(surface.rest + (surface.basis.double() @ own[0]))
    read = FaceReading(marks.float(), torch.full((68,), 2 * noise), torch.ones(68), torch.ones(()))
    read = replace(read, eye_visibility=torch.zeros(2))
    return replace(read, points=dense.float(), point_deviation=torch.full((COUNT,), 0.2))


def solved(solver: WebcamSolver, read: FaceReading, frames: int = 8) -> Tensor:
    state = solver.start()
    for _ in range(frames):
        state = solver.step(state, read, 1 / 15)
    return state.shapes.double() @ solver.to_arkit.T


def test_what_landmarks_say_of_points_is_their_regression(solver: WebcamSolver) -> None:
    """Of people drawn from the modes: the coefficients' linear prediction leaves no correlation with them."""
    rig, heads = performer(texture=False), zoo.get_model("head")
    modes = heads.shape.modes.double()
    who = torch.randn(4000, len(modes), generator=torch.Generator().manual_seed(1)).double()
    landmarks = torch.einsum("bk,klc->blc", who, modes[:, heads.landmarks]).flatten(1)
    surface, basis = surface_of(solver), solver.person.person_basis.reshape(204, -1)
    visible = torch.tensor([1.0, 1.0, 0.4]).double().repeat(68)
    directions = visible[:, None] * basis
    coefficients = (landmarks * visible) @ (directions / directions.square().sum(0))
    sites = (surface.rest[:, None] - rig.vertices.double()).norm(dim=2).argmin(1)
    points = torch.einsum("bk,kpc->bpc", who, modes[:, sites])
    left = points - torch.einsum("pcd,bd->bpc", surface.person_basis, coefficients)
    # Landmarks of the modes alone lack the finder's habits, so what is explained is a little less than all.
    assert float(left.square().mean()) < 0.35 * float(points.square().mean())


def test_points_show_what_noisy_landmarks_do_not(solver: WebcamSolver) -> None:
    weights = torch.zeros(52, dtype=torch.float64)
    for name, value in {"mouthSmileLeft": 0.6, "mouthSmileRight": 0.5, "jawOpen": 0.3, "cheekPuff": 0.4}.items():
        weights[ARKIT.index(name)] = value
    read = reading(solver, weights, 1.5)
    unseen = replace(read, points=read.points * torch.nan, point_deviation=read.point_deviation + torch.inf)
    with_points, without = ((solved(solver, one) - weights).square().mean().sqrt() for one in (read, unseen))
    assert float(with_points) < 0.6 * float(without)


def test_an_expression_that_is_read_decides_what_is_not_seen(solver: WebcamSolver) -> None:
    weights = torch.zeros(52, dtype=torch.float64)
    weights[ARKIT.index("cheekPuff")] = 0.5
    read = reading(solver, 0 * weights, 0.5)
    deviation = torch.full((52,), torch.inf)
    deviation[ARKIT.index("cheekPuff")] = 0.002
    told = replace(
        read,
        points=read.points * torch.nan,
        point_deviation=read.point_deviation + torch.inf,
        expression=weights.float(),
        expression_deviation=deviation,
    )
    found = solved(solver, told)
    assert float(found[ARKIT.index("cheekPuff")]) > 0.3
    silent = replace(told, expression_deviation=torch.full((52,), torch.inf))
    assert float(solved(solver, silent)[ARKIT.index("cheekPuff")]) < 0.15


def test_antagonists_are_never_on_together(solver: WebcamSolver) -> None:
    state, pairs = solver.start(), solver.arkit_signed
    for frame in range(12):
        weights = torch.zeros(52, dtype=torch.float64)
        weights[ARKIT.index("mouthLeft" if frame < 6 else "mouthRight")] = 0.6
        weights[ARKIT.index("mouthSmileLeft" if frame % 4 < 2 else "mouthFrownLeft")] = 0.5
        state = solver.step(state, reading(solver, weights, 0.7, frame), 1 / 15)
        first, second = state.weights.double() @ pairs.T.clamp(min=0), state.weights.double() @ (-pairs.T).clamp(min=0)
        assert float(torch.minimum(first, second).max()) < 1e-6
    assert float(state.weights[ARKIT.index("mouthRight")]) > 0.2
