"""Tests of the solve with every vertex as a marker, on planted weights of the embedded performer."""

import pytest
import torch

from torchface.capture.markers.mesh_solver import MeshSolver
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer

FRAMES = 40


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=False)


@pytest.fixture(scope="module")
def solver(rig: BlendshapeRig) -> MeshSolver:
    return MeshSolver(rig)


@pytest.fixture(scope="module")
def weights(rig: BlendshapeRig) -> torch.Tensor:
    """Curves that rise and fall; a third of the shapes at once at most."""
    generator = torch.Generator().manual_seed(1)
    phase = 6.3 * torch.rand(len(rig.names), generator=generator)
    curves = torch.sin(0.25 * torch.arange(FRAMES)[:, None] + phase) - 0.4
    return curves.clamp(0, 1)


def moved(meshes: torch.Tensor) -> torch.Tensor:
    """Every frame turned and moved by another amount."""
    steps = torch.linspace(-1, 1, len(meshes), dtype=torch.float64)[:, None]
    turns = rotation_matrix(steps * torch.tensor([0.3, 1.2, -0.2]))
    return meshes.double() @ turns.transpose(1, 2) + (steps * torch.tensor([400.0, 30.0, -900.0]))[:, None]


def test_weights_come_back_from_heads_that_move(rig: BlendshapeRig, solver: MeshSolver, weights: torch.Tensor) -> None:
    meshes = moved(rig(weights))
    found = solver.solve(lambda a, b: meshes[a:b], FRAMES, 30.0, temporal=False)
    assert float((found.weights - weights).abs().max()) < 0.02
    assert float(found.error.max()) < 0.05
    calm = solver.solve(lambda a, b: meshes[a:b], FRAMES, 30.0)
    assert float((calm.weights - weights).abs().mean()) < 0.02
    assert bool(((calm.weights >= 0) & (calm.weights <= 1)).all())


def test_the_error_is_the_distance_from_the_rig(rig: BlendshapeRig, solver: MeshSolver, weights: torch.Tensor) -> None:
    """What no shape shows is left over: its root mean square is told to a micrometre, by frame and by vertex."""
    generator = torch.Generator().manual_seed(2)
    own = torch.randn(FRAMES, *rig.vertices.shape, generator=generator)
    meshes = rig(weights) + own
    found = solver.solve(lambda a, b: meshes[a:b], FRAMES, 30.0, temporal=False)
    left, motion = solver.residual(meshes, found.weights)
    assert torch.allclose(found.error, left.square().sum(-1).mean(1).sqrt(), atol=1e-6)
    assert torch.allclose(found.motion, motion.square().sum(-1).mean(1).sqrt(), atol=1e-6)
    assert bool((found.unbounded <= found.error + 1e-9).all())
    assert abs(float(found.error.mean()) - 3**0.5) < 0.03


def test_the_whole_take_is_calmer_than_its_frames_under_noise(
    rig: BlendshapeRig, solver: MeshSolver, weights: torch.Tensor
) -> None:
    noise = torch.randn(FRAMES, *rig.vertices.shape, generator=torch.Generator().manual_seed(3))
    meshes = rig(weights) + 3 * noise

    def jitter(temporal: bool) -> float:
        found = solver.solve(lambda a, b: meshes[a:b], FRAMES, 60.0, temporal=temporal).weights
        return float(found.diff(n=2, dim=0).abs().mean())

    assert jitter(True) < 0.8 * jitter(False)


def test_other_meshes_are_refused(solver: MeshSolver, rig: BlendshapeRig) -> None:
    with pytest.raises(ShapeError, match="expected"):
        solver.equations(torch.zeros(1, 5, 3))
    broken = rig.vertices[None].clone()
    broken[0, 7, 1] = torch.nan
    with pytest.raises(ValueRangeError, match="NaN"):
        solver.equations(broken)
    with pytest.raises(ValueRangeError, match="times the rig's size"):
        solver.check_unit(rig.vertices / 10)
    assert solver.scale_of(rig.vertices / 10) == pytest.approx(0.1, rel=1e-4)
