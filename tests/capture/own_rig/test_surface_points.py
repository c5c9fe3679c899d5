"""Points of the surface: their derivatives, what faces away, and what they add to a solve."""

from __future__ import annotations

import functools
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import Attachment
from torchface.capture.own_rig import VideoSettings, VideoSolver
from torchface.capture.own_rig.face_measurements import FaceMeasurements
from torchface.capture.own_rig.gauss_newton import HeadState, Linearised
from torchface.capture.own_rig.surface_offsets import surface_offsets
from torchface.capture.own_rig.surface_points import FaceSurfacePoints, alike_errors, smooth_modes
from torchface.capture.weight_readings import WeightReadings
from torchface.errors import ShapeError
from torchface.geometry.rotations import rotation_matrix
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)
NAMES = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "noseSneerLeft", "noseSneerRight", "cheekPuff", "mouthLeft")
FRAMES = 4


@functools.cache
def actor() -> BlendshapeRig:
    return performer(texture=False).select(NAMES)


@functools.cache
def sites() -> Attachment:
    """Vertices spread over the front of the face."""
    place = actor().vertices
    front = ((place[:, 2] > 10) & (place[:, 1].abs() < 90)).nonzero()[:, 0]
    return Attachment.from_vertices(actor().neutral, front[torch.linspace(0, len(front) - 1, 200).long()])


def pose(frames: int = FRAMES) -> tuple[Tensor, Tensor]:
    angles = torch.linspace(-0.2, 0.3, frames, dtype=torch.float64)[:, None] * torch.tensor([0.3, 1.0, 0.1]).double()
    upright = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
    away = torch.tensor([5.0, -3.0, 500.0], dtype=torch.float64).repeat(frames, 1)
    return upright @ rotation_matrix(angles), away


def planted(surface: FaceSurfacePoints, weights: Tensor) -> Tensor:
    rotation, translation = pose(len(weights))
    placed = surface.rest + torch.einsum("tn,pcn->tpc", weights, surface.basis.double())
    image = (placed @ rotation.mT + translation[:, None]) @ K.T
    return image[..., :2] / image[..., 2:]


def film() -> tuple[VideoSolver, Tensor, Tensor, Tensor]:
    """A solver with points, weights (T,7), landmarks and points as they project."""
    settings = VideoSettings(pixel_noise=0.05, contour_slide=1.0, sparsity=0.0, ridge=1e-6)
    solver = VideoSolver(actor(), None, K, settings=settings, surface=sites())
    weights = 0.6 * torch.rand(FRAMES, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    surface, points = solver.surface, solver.points
    assert surface is not None
    marks = replace(surface, rest=points.rest[:68], basis=points.basis[:68])
    return solver, weights, planted(marks, weights), planted(surface, weights)


def test_the_energys_slope_is_that_of_the_squared_errors() -> None:
    surface = FaceSurfacePoints.of(actor(), sites())
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(1, 7, generator=generator, dtype=torch.float64)
    rotation, translation = (x[:1] for x in pose())
    head = HeadState(weights, rotation, translation)
    found = planted(surface, weights) + torch.randn(1, 200, 2, generator=generator, dtype=torch.float64)
    precision = torch.rand(1, 200, generator=generator, dtype=torch.float64)

    def squared(step: Tensor) -> Tensor:
        at = head.stepped(step)
        placed = surface.rest + torch.einsum("tn,pcn->tpc", at.weights, surface.basis)
        image = (placed @ at.rotation.mT + at.translation[:, None]) @ K.T
        return 0.5 * ((image[..., :2] / image[..., 2:] - found) * precision[..., None]).square().sum()

    energy = surface.linearised(head, K, found, precision).energy()
    for row in range(13):
        step = torch.zeros(1, 13, dtype=torch.float64)
        step[0, row] = 1e-5
        slope = (squared(step) - squared(-step)) / 2e-5
        assert float(energy.f[0, row]) == pytest.approx(float(slope), rel=1e-5, abs=1e-5)
    # H is that of Gauss and Newton: exact where nothing is left over.
    exact = surface.linearised(head, K, planted(surface, weights), precision).energy()
    found = planted(surface, weights)
    step = 1e-4 * torch.randn(1, 13, generator=generator, dtype=torch.float64)
    assert float(squared(step)) == pytest.approx(float(0.5 * step @ exact.H[0] @ step.T), rel=1e-2)


def test_points_recover_what_68_landmarks_leave_open() -> None:
    solver, weights, landmarks, points = film()
    noise = torch.randn(FRAMES, 68, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    seen = landmarks + 0.5 * noise
    few = solver(seen).weights
    many = solver(
        seen, measured=FaceMeasurements(torch.full((FRAMES, 68), 0.5), points, torch.full((FRAMES, 200), 0.01))
    ).weights
    assert float((many - weights).abs().max()) < 0.02
    assert float((few - weights).abs().max()) > 3 * float((many - weights).abs().max())


def test_two_copies_of_a_point_at_half_its_information_are_one() -> None:
    solver, _, landmarks, points = film()
    solver = VideoSolver(
        actor(), None, K, settings=replace(solver.settings, alike=0.0, pixel_noise=1e-6), surface=sites()
    )
    once = sites()
    twice = Attachment(once.triangles.repeat(2), once.barycentric.repeat(2, 1))
    doubled = VideoSolver(actor(), None, K, settings=solver.settings, surface=twice)
    off = points + torch.randn(points.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    deviation, marks = torch.full((FRAMES, 200), 2.0).double(), torch.full((FRAMES, 68), 2.0).double()
    one = solver(landmarks, measured=FaceMeasurements(marks, off, deviation))
    both = doubled(landmarks, measured=FaceMeasurements(marks, off.repeat(1, 2, 1), 2**0.5 * deviation.repeat(1, 2)))
    assert torch.allclose(one.weights, both.weights, atol=1e-6)


def test_errors_that_are_alike_count_by_the_inverse_of_their_covariance() -> None:
    solver, weights, landmarks, points = film()
    surface, head = solver.surface, HeadState(weights[:1], *(x[:1] for x in pose()))
    assert surface is not None
    own, alike = alike_errors(solver.error_modes, torch.ones(1, 268).double())
    ones = torch.ones(1, 268).double()
    found = points[:1] + torch.randn(1, 200, 2, generator=torch.Generator().manual_seed(0)).double()
    marks = replace(surface, rest=solver.points.rest[:68], basis=solver.points.basis[:68])
    first = marks.linearised(head, K, landmarks[:1] + 1.0, ones[:, :68] / own[:, :68])
    then = replace(surface, basis=surface.basis.double()).linearised(head, K, found, ones[:, 68:] / own[:, 68:])
    energy = first.energy_beside(then, alike)
    both = Linearised(
        torch.cat([first.residual, then.residual], dim=1), torch.cat([first.jacobian, then.jacobian], dim=1)
    )
    modes = solver.error_modes
    covariance = (own[0].square().diag() + modes @ modes.T).inverse()
    J, r = both.jacobian[0] * own[0, :, None, None], both.residual[0] * own[0, :, None]  # in pixels
    H = torch.einsum("lci,lm,mcj->ij", J, covariance, J)
    f = torch.einsum("lci,lm,mc->i", J, covariance, r)
    assert torch.allclose(energy.H[0], H, rtol=1e-8, atol=1e-8 * float(H.max()))
    assert torch.allclose(energy.f[0], f, rtol=1e-8, atol=1e-8 * float(f.abs().max()))


def test_modes_are_those_of_a_kernel() -> None:
    places = sites().on(actor().neutral.faces, actor().vertices)
    modes = smooth_modes(places, 60.0)
    kernel = torch.exp(-0.5 * (torch.cdist(places, places).double() / 60.0).square())
    assert float((modes @ modes.T - kernel).abs().max()) < 0.15
    assert float((modes @ modes.T - kernel).abs().mean()) < 0.02


def test_the_order_of_points_does_not_matter() -> None:
    solver, _, landmarks, points = film()
    order = torch.randperm(200, generator=torch.Generator().manual_seed(0))
    once = sites()
    other = VideoSolver(
        actor(), None, K, settings=solver.settings,
        surface=Attachment(once.triangles[order], once.barycentric[order]),
    )  # fmt: skip
    deviation = 0.5 + torch.rand(FRAMES, 200, generator=torch.Generator().manual_seed(1))
    off = points + torch.randn(points.shape, generator=torch.Generator().manual_seed(2)).double()
    one = solver(landmarks, measured=FaceMeasurements(None, off, deviation))
    both = other(landmarks, measured=FaceMeasurements(None, off[:, order], deviation[:, order]))
    assert torch.allclose(one.weights, both.weights, atol=1e-6)


def test_points_that_face_away_do_not_count() -> None:
    surface = FaceSurfacePoints.of(actor(), sites())
    rotation, translation = pose()
    behind = rotation @ rotation_matrix(torch.tensor([[0.0, torch.pi, 0.0]]).double())
    forward = surface.normals[:, 2] > 0.8
    assert int(forward.sum()) > 40
    assert float(surface.facing(rotation, translation)[:, forward].min()) > 0.95
    assert float(surface.facing(behind, translation)[:, forward].max()) == 0


def test_unseen_points_and_readings_leave_the_solve_as_it_is() -> None:
    solver, _, landmarks, points = film()
    plain = solver(landmarks).weights
    nothing = FaceMeasurements(
        None,
        torch.full_like(points, torch.nan),
        torch.full((FRAMES, 200), torch.inf),
        WeightReadings.of_expression(torch.full((FRAMES, 52), torch.nan), torch.full((FRAMES, 52), torch.inf), NAMES),
    )
    assert torch.equal(solver(landmarks, measured=nothing).weights, plain)


def test_readings_decide_what_landmarks_do_not_show() -> None:
    solver, weights, landmarks, _ = film()
    solver = VideoSolver(actor(), None, K, settings=replace(solver.settings, pixel_noise=20.0))
    read = WeightReadings(torch.eye(7), weights, torch.full((FRAMES, 7), 0.01))
    found = solver(landmarks, measured=FaceMeasurements(weights=read)).weights
    assert float((found - weights).abs().max()) < 0.02


def test_gradients_of_points_are_those_of_differences() -> None:
    solver, _, landmarks, points = film()
    solver = VideoSolver(
        actor(), None, K, settings=replace(solver.settings, tolerance=1e-9, pixel_noise=1.0), surface=sites()
    )
    points = points[:1] + 0.3 * torch.randn(1, 200, 2, generator=torch.Generator().manual_seed(1)).double()
    direction = torch.randn(1, 200, 2, generator=torch.Generator().manual_seed(2)).double()

    def jaw(given: Tensor) -> Tensor:
        measured = FaceMeasurements(None, given, torch.ones(1, 200))
        return solver(landmarks[:1], measured=measured).weights[0, 0]

    leaf = points.clone().requires_grad_()
    (slope,) = torch.autograd.grad(jaw(leaf), leaf)
    with torch.no_grad():
        difference = (jaw(points + 0.02 * direction) - jaw(points - 0.02 * direction)) / 0.04
    assert float((slope * direction).sum()) == pytest.approx(float(difference), rel=2e-2, abs=1e-7)


def test_points_are_kept_with_the_solver() -> None:
    solver, _, landmarks, points = film()
    made = VideoSolver.from_config(solver.config)
    made.load_state_dict(solver.state_dict())
    measured = FaceMeasurements(None, points, torch.ones(FRAMES, 200))
    assert torch.allclose(made(landmarks, measured=measured).weights, solver(landmarks, measured=measured).weights)  # type: ignore[operator]
    with pytest.raises(ShapeError, match=r"measured points: found \(1, 5, 2\), expected \(1, 200, 2\)"):
        solver(landmarks, measured=FaceMeasurements(None, points[:, :5], torch.ones(FRAMES, 5)))


def test_planted_offsets_come_back_though_half_of_the_take_smiles() -> None:
    settings = VideoSettings(pixel_noise=0.3, contour_slide=1.0, sparsity=0.1)
    solver = VideoSolver(actor(), None, K, settings=settings, surface=sites())
    surface, points = solver.surface, solver.points
    assert surface is not None
    weights = torch.zeros(24, 7, dtype=torch.float64)
    weights[12:, 1:3] = 0.8
    offsets = 3 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0)).double()
    offsets[:, 2] = 0  # along the line of sight little is seen
    person = VideoSolver(actor(), None, K, settings=settings, surface=sites()).with_surface_moved(offsets).surface
    assert person is not None
    landmarks = planted(FaceSurfacePoints(points.rest[:68], points.basis[:68], torch.zeros(68, 3).double()), weights)
    measured = FaceMeasurements(None, planted(person, weights), torch.ones(24, 200))
    found = surface_offsets(solver, landmarks, torch.ones(24, 68), measured)
    assert found is not None
    seen = surface.facing(*pose(24)).amin(0) > 0.9
    assert float((found - offsets)[seen][:, :2].square().mean().sqrt()) < 0.6
    few = FaceMeasurements(None, measured.points[:5], measured.point_deviation[:5])  # type: ignore[index]
    assert surface_offsets(solver, landmarks[:5], torch.ones(5, 68), few) is None
