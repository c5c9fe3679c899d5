"""A rig of film size (80 shapes, 400 correctives, 10,000 vertices) beside the linear solve and scipy's."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from corrective_scene import Scene, film_scene
from scipy.optimize import least_squares, minimize
from torch import Tensor

from torchface.capture import MarkerSolver, WholeTakeSolver
from torchface.capture.corrective_energy import CorrectiveEnergy

FRAMES, PEER_FRAMES = 120, 4
SPARSITY, RIDGE, SMOOTHNESS = 1e-2, 1e-4, 100.0
ACTIVE = 1e-3

pytestmark = pytest.mark.bench


@dataclass(frozen=True)
class Row:
    """One way to solve: error in millimetres, shapes above 0.001, mean squared second difference, ms a frame."""

    name: str
    error: float
    seen: float
    energy: float
    active: float
    roughness: float
    milliseconds: float

    def __str__(self) -> str:
        return (
            f"{self.name:34} {self.error:8.3f} {self.seen:8.3f} {self.energy:9.4f} {self.active:7.1f} "
            f"{self.roughness:10.1e} {self.milliseconds:9.1f}"
        )


def timed(solve: Callable[[], Tensor], frames: int) -> tuple[Tensor, float]:
    begin = time.process_time()
    weights = solve()
    return weights, 1000 * (time.process_time() - begin) / frames


def row(name: str, scene: Scene, energy: CorrectiveEnergy, weights: Tensor, milliseconds: float) -> Row:
    count = len(weights)
    face = scene.rig(weights.float())
    bent = weights[2:] - 2 * weights[1:-1] + weights[:-2]
    return Row(
        name,
        float((face - scene.face[:count]).norm(dim=-1).mean()),
        float((face - scene.seen[:count]).square().sum(-1).mean().sqrt()),
        float(energy.rows(torch.arange(count)).value(weights.double()).mean()),
        float((weights > ACTIVE).sum(1).double().mean()),
        float(bent.square().mean()) if count > 2 else float("nan"),
        milliseconds,
    )


def peers(solver: MarkerSolver, energy: CorrectiveEnergy, start: Tensor, method: str) -> Tensor:
    """The same energy by scipy's solvers, a frame at a time, from the linear answer, with exact derivatives."""
    found = []
    root = torch.linalg.cholesky(
        energy.extended.H + 1e-10 * torch.eye(len(energy.extended.H), dtype=torch.float64), upper=True
    )
    for frame in range(len(start)):
        here = energy.rows(torch.tensor([frame]))
        # The whole energy is a square: a root of the sparsity's term of its own would be steepest at zero.
        target = -torch.linalg.solve_triangular(root.T, here.extended.f[0][:, None], upper=False)[:, 0]

        def value(w: np.ndarray, here: CorrectiveEnergy = here) -> tuple[float, np.ndarray]:
            at = torch.from_numpy(w)[None]
            return float(here.value(at)), here.gradient(at)[0].numpy()

        def residual(w: np.ndarray, target: Tensor = target) -> np.ndarray:
            at = torch.from_numpy(w)[None]
            return (root @ torch.cat([at, energy.activation(at)], 1)[0] - target).numpy()

        def jacobian(w: np.ndarray) -> np.ndarray:
            by = energy.activation.jacobian(torch.from_numpy(w)[None])[0]
            return (root @ torch.cat([torch.eye(80, dtype=torch.float64), by])).numpy()

        w0 = start[frame].double().numpy()
        if method == "SLSQP":
            solved = minimize(value, w0, jac=True, bounds=[(0, 1)] * 80, method="SLSQP", options={"maxiter": 300})
        else:
            solved = least_squares(residual, w0.clip(1e-6, 1 - 1e-6), jacobian, bounds=(0, 1), max_nfev=200)
        found.append(torch.from_numpy(solved.x.clip(0, 1)))
    return torch.stack(found)


def test_a_film_rig_with_correctives() -> None:
    scene = film_scene(FRAMES)
    solver = scene.solver(sparsity=SPARSITY, ridge=RIDGE)
    solver(scene.seen[:2])
    energy = solver.complete_energy(scene.seen)
    assert isinstance(energy, CorrectiveEnergy)
    linear = solver.without_correctives()
    linear(scene.seen[:2])
    start, fast = timed(lambda: linear(scene.seen), FRAMES)
    ours, quick = timed(lambda: solver(scene.seen), FRAMES)
    whole = WholeTakeSolver(solver, smoothness=SMOOTHNESS, sparsity=SPARSITY)
    smooth, slower = timed(lambda: whole(scene.seen), FRAMES)
    rows = [
        row("truth", scene, energy, scene.weights, 0.0),
        row("linear, correctives left out", scene, energy, start, fast),
        row("torchface, frame by frame", scene, energy, ours, quick),
        row("torchface, whole take", scene, energy, smooth, slower),
    ]
    few = scene.seen[:: FRAMES // PEER_FRAMES][:PEER_FRAMES]
    here = Scene(scene.rig, scene.weights, scene.face[:: FRAMES // PEER_FRAMES][:PEER_FRAMES], few)
    some = energy.rows(torch.arange(0, FRAMES, FRAMES // PEER_FRAMES)[:PEER_FRAMES])
    chosen = slice(None, None, FRAMES // PEER_FRAMES)
    rows.append(row(f"torchface, {PEER_FRAMES} of these frames", here, some, ours[chosen][:PEER_FRAMES], quick))
    for method in ("SLSQP", "least_squares (trf)"):
        begin = start[chosen][:PEER_FRAMES]
        found, spent = timed(lambda begin=begin, method=method: peers(solver, some, begin, method), PEER_FRAMES)
        rows.append(row(f"scipy {method}, {PEER_FRAMES} frames", here, some, found, spent))
    print(f"\n{'':34} {'error mm':>8} {'seen mm':>8} {'energy':>9} {'active':>7} {'roughness':>10} {'ms':>9}")
    print("\n".join(map(str, rows)))
    truth, left_out, single, take, same, *others = rows
    assert single.error < 0.5 * left_out.error
    assert take.error < 1.1 * single.error
    assert take.roughness < 0.25 * single.roughness
    assert take.roughness < 4 * truth.roughness
    for other in others:
        assert same.energy < 1.02 * other.energy
        assert same.milliseconds < 0.2 * other.milliseconds
