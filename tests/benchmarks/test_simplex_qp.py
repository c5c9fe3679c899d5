"""simplex_qp beside OSQP and quadprog: mixtures of few of many frames, all in one run, on one thread."""

import time

import numpy as np
import pytest
import torch
from quadratic_programming_peers import installed
from scipy.sparse import csc_matrix, eye, vstack
from torch import Tensor

from torchface.optim import simplex_qp

pytestmark = pytest.mark.usefixtures("one_thread")
FRAMES = 30


def mixtures(database: int, features: int, noise: float) -> tuple[Tensor, Tensor]:
    """Frames (B) that are mixtures of few of the N of a database, seen with noise: H (N,N) with a ridge, f (B,N)."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(features, database, generator=generator, dtype=torch.float64)
    mixture = torch.rand(FRAMES, database, generator=generator, dtype=torch.float64) ** 60
    target = (mixture / mixture.sum(1, keepdim=True)) @ points.T
    target = target + noise * torch.randn(target.shape, generator=generator, dtype=torch.float64)
    return points.T @ points + 1e-4 * torch.eye(database, dtype=torch.float64), -target @ points


def osqp_frames(H: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Set up once, updated, from the iterate of the frame before."""
    import osqp

    size = len(H)
    solver = osqp.OSQP()
    rows = vstack([csc_matrix(np.ones((1, size))), eye(size)]).tocsc()
    low, high = np.r_[1.0, np.zeros(size)], np.r_[1.0, np.full(size, np.inf)]
    tolerances = {"eps_abs": 1e-6, "eps_rel": 1e-6, "max_iter": 20000}
    solver.setup(csc_matrix(np.triu(H)), f[0], rows, low, high, verbose=False, warm_starting=True, **tolerances)
    found = []
    for row in f:
        solver.update(q=row)
        found.append(solver.solve(raise_error=False).x)
    return np.stack(found)


def quadprog_frames(H: np.ndarray, f: np.ndarray) -> np.ndarray:
    import quadprog

    size = len(H)
    columns, bounds = np.concatenate([np.ones((size, 1)), np.eye(size)], 1), np.r_[1.0, np.zeros(size)]
    return np.stack([quadprog.solve_qp(H, -row, columns, bounds, 1)[0] for row in f])


def test_beside_peers() -> None:
    print(f"\n{'frames in the database':>22} {'active':>7} {'solver':>12} {'ms a frame':>11} {'above the least':>16}")
    for database, features, noise in ((100, 60, 0.1), (400, 60, 0.1), (400, 540, 0.1), (1000, 540, 0.1)):
        H, f = mixtures(database, features, noise)
        began = time.perf_counter()
        ours = simplex_qp(H, f)
        rows = {"simplex_qp": (time.perf_counter() - began, ours)}
        for name, module, solve in (("OSQP 1e-6", "osqp", osqp_frames), ("quadprog", "quadprog", quadprog_frames)):
            if (name == "quadprog" and database > 400) or not installed(module):  # minutes
                continue
            began = time.perf_counter()
            found = solve(H.numpy(), f.numpy())
            rows[name] = (time.perf_counter() - began, torch.from_numpy(found))
        energies = {name: 0.5 * ((x @ H) * x).sum(1) + (f * x).sum(1) for name, (_, x) in rows.items()}
        for name, (seconds, x) in rows.items():
            active = float((x > 1e-6).sum(1).double().mean())
            above = float((energies[name] - energies["simplex_qp"]).max())
            print(f"{database:>22} {active:>7.1f} {name:>12} {1000 * seconds / FRAMES:>11.2f} {above:>16.1e}")
        exact = energies.get("quadprog")
        if exact is not None:
            assert float((energies["simplex_qp"] - exact).max()) <= 1e-9 * float(H.diagonal().max())
        assert rows["simplex_qp"][0] < min(seconds for name, (seconds, _) in rows.items() if name != "simplex_qp")
