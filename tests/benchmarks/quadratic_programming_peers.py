"""Other solvers of box-constrained quadratic programs, each set up once, updated and warm-started where it can be.

A solver takes f (N,) and gives x (N,), for one H and the box [0, 1]; what it remembers of the call before is its own.
One for an H a call takes H (N,N) and f.
"""

from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import torch
from scipy.optimize import lsq_linear
from scipy.sparse import csc_matrix, eye
from torch import Tensor

Solver = Callable[..., np.ndarray]
HessianSolver = Callable[[np.ndarray, np.ndarray], np.ndarray]


def daqp_solver(H: np.ndarray) -> Solver:
    """A dual active set; each call starts from the active set of the one before."""
    import daqp

    size = len(H)
    solver = daqp.Model()
    solver.setup(H, np.zeros(size), np.zeros((0, size)), np.ones(size), np.zeros(size), np.zeros(size, np.int32))

    def solve(f: np.ndarray, **changed: np.ndarray) -> np.ndarray:
        solver.update(f=f, **changed)
        return np.clip(solver.solve()[0], 0, 1)

    return solve


def piqp_solver(H: np.ndarray, tolerance: float | None = None) -> Solver:
    """An interior point, which has no warm start; its own tolerance of 1e-8 if none is given."""
    import piqp

    solver = piqp.DenseSolver()
    if tolerance is not None:
        solver.settings.eps_abs = solver.settings.eps_duality_gap_abs = tolerance
        solver.settings.eps_rel = solver.settings.eps_duality_gap_rel = tolerance
    size = len(H)
    solver.setup(H, np.zeros(size), None, None, None, None, None, np.zeros(size), np.ones(size))

    def solve(f: np.ndarray, **changed: np.ndarray) -> np.ndarray:
        solver.update(c=f, **changed)
        solver.solve()
        return np.clip(solver.result.x, 0, 1)

    return solve


def osqp_solver(H: np.ndarray, tolerance: float = 1e-5) -> Solver:
    """Splitting, from the iterate of the call before."""
    import osqp

    size = len(H)
    solver = osqp.OSQP()
    solver.setup(
        csc_matrix(np.triu(H)),
        np.zeros(size),
        csc_matrix(eye(size)),
        np.zeros(size),
        np.ones(size),
        verbose=False,
        eps_abs=tolerance,
        eps_rel=tolerance,
        max_iter=20000,
        warm_starting=True,
        check_termination=10,
    )

    def solve(f: np.ndarray) -> np.ndarray:
        solver.update(q=f)
        return np.clip(solver.solve(raise_error=False).x, 0, 1)

    return solve


def proxqp_solver(H: np.ndarray, tolerance: float = 1e-8) -> Solver:
    """An augmented Lagrangian, from the solution of the call before."""
    import proxsuite

    size = len(H)
    solver = proxsuite.proxqp.dense.QP(size, 0, 0, True)
    solver.settings.eps_abs, solver.settings.eps_rel = tolerance, 0.0
    solver.settings.initial_guess = proxsuite.proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
    solver.init(H, np.zeros(size), None, None, None, None, None, np.zeros(size), np.ones(size))
    solver.solve()

    def solve(f: np.ndarray) -> np.ndarray:
        solver.update(g=f)
        solver.solve()
        return np.clip(solver.results.x, 0, 1)

    return solve


def quadprog_solver(H: np.ndarray) -> Solver:
    import quadprog

    size = len(H)
    normals = np.hstack([np.eye(size), -np.eye(size)])
    offsets = np.concatenate([np.zeros(size), -np.ones(size)])
    # The Cholesky factor's inverse, made once, is what it takes for a prepared H; it has no warm start.
    factor = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(H)).T)
    return lambda f: quadprog.solve_qp(factor, -f, normals, offsets, 0, True)[0]


def lsq_solver(H: np.ndarray) -> Solver:
    """scipy's, which takes no start."""
    root = np.linalg.cholesky(H).T
    return lambda f: lsq_linear(root, np.linalg.solve(root.T, -f), (0, 1), method="bvls", tol=1e-10).x


def installed(module: str) -> bool:
    """Whether a peer is there; where it is not, its row is left out."""
    if find_spec(module) is None:
        print(f"{module} is not installed (pip install {module}): its row is left out")
        return False
    return True


def daqp_with_hessians(size: int) -> HessianSolver:
    solve = daqp_solver(np.eye(size))
    return lambda H, f: solve(f, H=H)


def piqp_with_hessians(size: int) -> HessianSolver:
    solve = piqp_solver(np.eye(size))
    return lambda H, f: solve(f, P=H)


def quadprog_with_hessians(size: int) -> HessianSolver:
    import quadprog

    normals = np.hstack([np.eye(size), -np.eye(size)])
    offsets = np.concatenate([np.zeros(size), -np.ones(size)])
    return lambda H, f: quadprog.solve_qp(H, -f, normals, offsets)[0]


def fista(H: Tensor, f: Tensor, steps: int = 400) -> Tensor:
    """Plain accelerated projected gradient, all f (B,N) at once."""
    rate = 1 / torch.linalg.eigvalsh(H.double())[-1].to(H)
    x = momentum = torch.zeros_like(f)
    speed = 1.0
    for _ in range(steps):
        following = (momentum - rate * (momentum @ H + f)).clamp(0, 1)
        next_speed = 0.5 * (1 + (1 + 4 * speed**2) ** 0.5)
        momentum = following + (speed - 1) / next_speed * (following - x)
        x, speed = following, next_speed
    return x


def batched_admm(H: Tensor, f: Tensor, steps: int, penalty: float = 0.1) -> Tensor:
    """OSQP's iteration with its scaling and relaxation, all f (B,N) at once; one factorisation, a fixed penalty.

    The penalty is the best of 0.03, 0.1 and 0.3 for the frames it is measured on.
    """
    scale = H.diagonal().rsqrt()
    lifted = (H * scale * scale[:, None]).double()
    lifted.diagonal().add_(penalty)
    inverse = torch.linalg.inv(lifted).to(f)
    upper, slope = 1 / scale, f * scale
    z, dual = torch.zeros_like(f), torch.zeros_like(f)
    for _ in range(steps):
        x = 1.6 * ((penalty * z - dual - slope) @ inverse) - 0.6 * z
        z = torch.minimum((x + dual / penalty).clamp(min=0), upper)
        dual = dual + penalty * (x - z)
    return z * scale
