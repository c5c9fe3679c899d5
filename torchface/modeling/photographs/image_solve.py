"""Joint Gauss-Newton over identity, expression, poses and focal length, each step a quadratic program in a box."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import MAX_SIDE
from torchface.modeling.photographs.landmark_view import (
    JAW,
    Linearised,
    LinearPoints,
    PickedPoints,
    Views,
    chosen_points,
    linearised,
    residuals,
)
from torchface.number_checks import LARGEST_WEIGHT, checked_count, checked_number
from torchface.optim import box_qp

_DONE, _HALVINGS = 1e-5, 6
_MAX_CONTOUR_ERROR, _SETTLED, _TRIAL_ITERATIONS = 1.5, 0.02, 3
_MIN_NOISE = 1e-5  # of the focal length: finer than any landmark is found


@dataclass(frozen=True)
class FitSettings:
    """The noise of landmarks, the priors on faces, and what is made of them.

    Args:
        inner_weight: of a squared error at brows, eyes, nose and mouth beside one at the contour.
        contour_slide: how much less an error along the face's contour counts than one across it, 0 to 1; 1 takes
            contour landmarks as points.
        sliding: contour landmarks of the far side move to the visible silhouette, as people and detectors mark them;
            False where they are vertices that may be hidden. Absent, what fits better is taken.
        expression_mean: how strong a shape is on average, in weights; the prior falls exponentially.
        expression_ridge: prior deviation of a weight beside that.
        asymmetry: prior deviation of the difference between a shape's weight and its mirror image's. Faces move almost
            alike on both sides, and 68 landmarks of a rotated head hardly distinguish a lopsided smile from it.
        identity_bound: on each coefficient, standard deviations.
        noise: of an inner landmark, pixels; estimated from the residuals if absent.
        focal_deviation: relative deviation of the true focal length from the given one; 0 takes it as exact.
        shared_focal: one focal length for all photographs.
        max_iterations: of Gauss-Newton.
        transfers: how often shapes are transferred to the head found; 0 keeps the template's.
        texture_size: of the skin, texels a side; 0 makes no texture.
        masked: only skin and the face's features are projected onto the head; see ``photographed_skin``.

    Raises:
        ValueRangeError: a setting is NaN, infinite or out of its range.

    Example:
        >>> FitSettings(focal_deviation=0.05, shared_focal=True).identity_bound
        3.0
    """

    inner_weight: float = 2.0
    contour_slide: float = 0.3
    sliding: bool | None = None
    expression_mean: float = 0.2
    expression_ridge: float = 0.5
    asymmetry: float = 0.1
    identity_bound: float = 3.0
    noise: float | None = None
    focal_deviation: float = 0.0
    shared_focal: bool = True
    max_iterations: int = 20
    transfers: int = 1
    texture_size: int = 1024
    masked: bool = True

    def __post_init__(self) -> None:
        for name in ("inner_weight", "expression_mean", "expression_ridge", "asymmetry", "identity_bound"):
            checked_number(name, getattr(self, name), 0.0, LARGEST_WEIGHT, above=True)
        if self.noise is not None:
            checked_number("noise", self.noise, above=True)
        checked_number("contour_slide", self.contour_slide, 0.0, 1.0)
        checked_number("focal_deviation", self.focal_deviation)
        checked_count("max_iterations", self.max_iterations, 1)
        checked_count("transfers", self.transfers)
        checked_count("texture_size", self.texture_size, 0, MAX_SIDE)


@dataclass(frozen=True, eq=False)
class Problem:
    """What is looked for and where it was seen.

    Args:
        points: landmarks and contour curves as functions of D coefficients, the first ``identities`` of them identity.
        identities: how many.
        found: landmarks, (I,68,2), NaN for missing.
        focal: the expected focal lengths, (I,), pixels.
        settings: see there.
        twins: rows of the coefficients of shapes that mirror each other, (K,2); none if absent.
    """

    points: LinearPoints
    identities: int
    found: Tensor
    focal: Tensor
    settings: FitSettings
    twins: Tensor | None = None

    @property
    def seen(self) -> Tensor:
        """Which landmarks are there, (I,68) bool."""
        return torch.isfinite(self.found).all(-1)

    @property
    def targets(self) -> Tensor:
        """The landmarks with zeros for missing ones."""
        return torch.where(self.seen[..., None], self.found, 0.0)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper, (D,)."""
        count, k = len(self.points.basis), self.identities
        lower, upper = torch.zeros(count, dtype=torch.float64), torch.ones(count, dtype=torch.float64)
        lower[:k], upper[:k] = -self.settings.identity_bound, self.settings.identity_bound
        return lower, upper

    def prior(self) -> tuple[Tensor, Tensor]:
        """Of the energy ½ xᵀ P x + βᵀ x: P (D,D) and β (D,)."""
        count, k = len(self.points.basis), self.identities
        ridge, linear = torch.ones(count, dtype=torch.float64), torch.zeros(count, dtype=torch.float64)
        ridge[k:] = 1 / self.settings.expression_ridge**2
        linear[k:] = 1 / self.settings.expression_mean
        precision = torch.diag(ridge)
        if self.twins is not None and len(self.twins):
            rows = torch.arange(len(self.twins))
            apart = torch.zeros(len(self.twins), count, dtype=torch.float64)
            apart[rows, self.twins[:, 0]], apart[rows, self.twins[:, 1]] = 1.0, -1.0
            precision = precision + apart.T @ apart / self.settings.asymmetry**2
        return precision, linear


@dataclass(frozen=True, eq=False)
class State:
    """Coefficients (D,), cameras, which point each landmark is (I,68), and the noise of an inner landmark, pixels."""

    coefficients: Tensor
    views: Views
    rows: Tensor
    noise: float


@dataclass(frozen=True, eq=False)
class Normal:
    """The normal equations after the cameras are eliminated, and what brings them back.

    Args:
        H: of the coefficients, (D,D), without the prior.
        g: (D,).
        back: the camera's step for one of the coefficients, (C,D), and at none, (C,).
    """

    H: Tensor
    g: Tensor
    back: Tensor
    alone: Tensor


def whitening(problem: Problem, state: State, picked: PickedPoints) -> Tensor:
    """What makes errors unit and independent, (I,68,2,2): the contour's by whether they lie along or across it."""
    settings = problem.settings
    factors = torch.eye(2, dtype=torch.float64).repeat(*problem.seen.shape, 1, 1)
    line = state.views.pixels(picked.at(state.coefficients))[:, :JAW]
    along = torch.cat([line[:, 1:2] - line[:, :1], line[:, 2:] - line[:, :-2], line[:, -1:] - line[:, -2:-1]], dim=1)
    along = torch.nn.functional.normalize(along, dim=-1)
    tangent = along[..., :, None] * along[..., None, :]
    factors[:, :JAW] -= (1 - settings.contour_slide) * tangent
    factors[:, :JAW] /= settings.inner_weight**0.5
    return factors * (problem.seen[..., None, None] / state.noise)


def step_focal(problem: Problem) -> Tensor:
    """How the unknowns of focal length, F of them, act on the views, (I,F)."""
    count, settings = len(problem.found), problem.settings
    if settings.focal_deviation == 0:
        return torch.zeros(count, 0, dtype=torch.float64)
    if settings.shared_focal:
        return torch.ones(count, 1, dtype=torch.float64)
    return torch.eye(count, dtype=torch.float64)


def normal_equations(problem: Problem, at: Linearised, views: Views) -> Normal:
    """Gauss-Newton's, with the cameras eliminated (Schur complement)."""
    count, D = len(problem.found), at.by_coefficients.shape[-1]
    focal = step_focal(problem)
    camera = torch.zeros(count, *at.residual.shape[1:], 6 * count + focal.shape[1], dtype=torch.float64)
    for i in range(count):  # views: each has its own six columns
        camera[i, ..., 6 * i : 6 * i + 6] = at.by_camera[i]
    camera[..., 6 * count :] = at.by_focal[..., None] * focal[:, None, None]
    A, B, r = at.by_coefficients.reshape(-1, D), camera.reshape(-1, camera.shape[-1]), at.residual.flatten()
    H_bb, g_b = B.T @ B, B.T @ r
    if focal.shape[1]:
        logs = (views.intrinsics[:, 0, 0] / problem.focal).log()
        precision = 1 / problem.settings.focal_deviation**2
        each = focal / focal.sum(0)
        H_bb.diagonal()[6 * count :] += precision
        g_b[6 * count :] += precision * (each.T @ logs)
    H_bb.diagonal().add_(1e-9 * H_bb.diagonal().clamp(min=1e-12))
    H_ba = B.T @ A
    factor = torch.linalg.cholesky(H_bb)
    solved = torch.cholesky_solve(torch.cat([H_ba, g_b[:, None]], dim=1), factor)
    back, alone = -solved[:, :-1], -solved[:, -1]
    H = A.T @ A + H_ba.T @ back
    return Normal(0.5 * (H + H.T), A.T @ r + H_ba.T @ alone, back, alone)


def energy(problem: Problem, state: State, picked: PickedPoints, factors: Tensor) -> float:
    """Minus the log posterior up to a constant, at fixed noise and chosen points."""
    precision, linear = problem.prior()
    x = state.coefficients
    at = residuals(picked, x, state.views, problem.targets, factors)
    total = 0.5 * at.square().sum() + 0.5 * (x @ precision @ x) + (linear * x).sum()
    focal = step_focal(problem)
    if focal.shape[1]:
        logs = (state.views.intrinsics[:, 0, 0] / problem.focal).log()
        total = total + 0.5 * ((focal / focal.sum(0)).T @ logs).square().sum() / problem.settings.focal_deviation**2
    return float(total)


def solve_either(problem: Problem, initial: State) -> tuple[Problem, State]:
    """``solve``, with sliding contour landmarks and where they fit ill without, whichever leaves less."""
    if problem.settings.sliding is not None:
        return problem, solve(problem, initial)
    sliding = replace(problem, settings=replace(problem.settings, sliding=True))
    state = solve(replace(sliding, settings=replace(sliding.settings, max_iterations=_TRIAL_ITERATIONS)), initial)
    if _contour_error(sliding, state) >= _MAX_CONTOUR_ERROR:
        fixed = replace(problem, settings=replace(problem.settings, sliding=False))
        other = solve(fixed, initial)
        if _contour_error(fixed, other) < _contour_error(sliding, state):
            return fixed, other
    return sliding, solve(sliding, state)


def _contour_error(problem: Problem, state: State) -> float:
    """Root mean square of contour landmarks in what is expected of them beside the inner ones: 1 if all is well."""
    picked = problem.points.picked(state.rows)
    factors = whitening(problem, state, picked)
    r = residuals(picked, state.coefficients, state.views, problem.targets, factors).square().sum(-1)
    contour, inner = problem.seen.clone(), problem.seen.clone()
    contour[:, JAW:], inner[:, :JAW] = False, False
    if not contour.any():
        return 0.0
    each = r[contour].mean() / (0.5 * (1 + problem.settings.contour_slide**2))
    return float((each / r[inner].mean().clamp(min=1e-12)).sqrt())


def solve(problem: Problem, state: State, free: Tensor | None = None) -> State:
    """Gauss-Newton until nothing changes.

    Args:
        problem: see there.
        state: the initial guess.
        free: which coefficients may change, (D,) bool; all if absent.
    """
    lower, upper = problem.bounds()
    precision, linear = problem.prior()
    for _ in range(problem.settings.max_iterations):
        if problem.settings.sliding:
            rows = chosen_points(problem.points, state.coefficients, state.views)
            state = replace(state, rows=rows)
        picked = problem.points.picked(state.rows)
        factors = whitening(problem, state, picked)
        at = linearised(picked, state.coefficients, state.views, problem.targets, factors)
        normal = normal_equations(problem, at, state.views)
        x = state.coefficients
        H = normal.H + precision
        f = normal.g - normal.H @ x + linear
        low, high = (lower, upper) if free is None else (torch.where(free, lower, x), torch.where(free, upper, x))
        goal = box_qp(H, f[None], low, high, start=x[None])[0]
        before = energy(problem, state, picked, factors)
        moved, after = _searched(problem, state, picked, factors, normal, goal - x, before)
        state = moved
        noise = state.noise
        if problem.settings.noise is None:
            state = replace(state, noise=_noise(problem, state, picked, factors, normal))
        # A falling noise changes what the energy weighs: there is more to come.
        if before - after < _DONE * max(abs(before), 1.0) and abs(state.noise - noise) < _SETTLED * noise:
            break
    return state


def _searched(
    problem: Problem, state: State, picked: PickedPoints, factors: Tensor, normal: Normal, change: Tensor, before: float
) -> tuple[State, float]:
    """The step, halved until the energy falls."""
    count, focal = len(problem.found), step_focal(problem)
    camera = normal.alone + normal.back @ change
    motion = camera[: 6 * count].reshape(count, 6)
    longer = focal @ camera[6 * count :]
    for halving in range(_HALVINGS):
        fraction = 0.5**halving
        tried = State(
            state.coefficients + fraction * change,
            state.views.moved(fraction * motion, fraction * longer),
            state.rows,
            state.noise,
        )
        after = energy(problem, tried, picked, factors)
        if after <= before:
            return tried, after
    return state, before


def _noise(problem: Problem, state: State, picked: PickedPoints, factors: Tensor, normal: Normal) -> float:
    """What is left over, for each number that neither the cameras nor the coefficients can explain."""
    r = residuals(picked, state.coefficients, state.views, problem.targets, factors)
    precision, _ = problem.prior()
    factor = torch.linalg.cholesky(precision)
    half = torch.linalg.solve_triangular(factor, normal.H, upper=False)
    values = torch.linalg.eigvalsh(torch.linalg.solve_triangular(factor, half.T, upper=False)).clamp(min=0)
    used = float((values / (values + 1)).sum()) + len(normal.alone)
    # A contour landmark that slides constrains hardly more than one number.
    measured = 2 * float(problem.seen.sum()) - (1 - problem.settings.contour_slide) * float(problem.seen[:, :JAW].sum())
    left = max(measured - used, 0.2 * measured)
    deviation = state.noise * (float(r.square().sum()) / left) ** 0.5
    return max(deviation, _MIN_NOISE * float(problem.focal.mean()))


def covariance(problem: Problem, state: State) -> Tensor:
    """Of the coefficients, (D,D), cameras unknown; rows of those that lie on a bound are zero."""
    picked = problem.points.picked(state.rows)
    factors = whitening(problem, state, picked)
    at = linearised(picked, state.coefficients, state.views, problem.targets, factors)
    precision, _ = problem.prior()
    H = normal_equations(problem, at, state.views).H + precision
    lower, upper = problem.bounds()
    x = state.coefficients
    inside = ((x > lower + 1e-9) & (x < upper - 1e-9)).nonzero()[:, 0]
    result = torch.zeros_like(H)
    result[inside[:, None], inside] = torch.linalg.inv(H[inside[:, None], inside])
    return result
