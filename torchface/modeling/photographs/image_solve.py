"""Joint Gauss-Newton over identity, expression, poses and focal length, each step a quadratic program in a box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import ShapeError
from torchface.geometry.cameras.pinhole import MAX_SIDE
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.modeling.photographs.landmark_view import (
    JAW,
    LANDMARKS,
    Linearised,
    LinearPoints,
    PickedPoints,
    Views,
    Whitening,
    chosen_points,
    linearised,
    residuals,
)
from torchface.number_checks import LARGEST_WEIGHT, checked_count, checked_number
from torchface.optim import box_qp

_DONE, _HALVINGS = 1e-5, 6
_MAX_CONTOUR_ERROR, _SETTLED, _TRIAL_ITERATIONS = 1.5, 0.02, 3
_MIN_NOISE = 1e-5  # of the focal length: finer than any landmark is found
_LEAST, _MOST, _FAR = 0.5, 4.0, 100.0  # deviations beside the median; of points of the surface
_FOUND_NOISE = 0.02  # of the distance of the eyes' outer corners
_EXPECTED, _LEAST_UNKNOWN = 2.0, 1e-2  # of unknown differences: how many are expected to be as large as expected


# Errors of found points, by 100 rendered pictures: of neighbours they go together as 0.5 exp(-d / 25 mm), and they are
# so much larger than stated at landmarks, smaller at points of the surface.
_TOGETHER, _ALIKE_OVER = 0.5, 25.0
_STATED_68, _STATED_POINTS = 1.2, 0.75


class WeightQuadratic(Protocol):
    """An energy ½ wᵀ H w + fᵀ w of weights (E,N): H (E,N,N) or (N,N), f (E,N)."""

    @property
    def H(self) -> Tensor: ...
    @property
    def f(self) -> Tensor: ...


class ExpressionPrior(Protocol):
    """Which weights faces have, as ``ShapePrior`` knows it."""

    def energy(self, weights: Tensor) -> WeightQuadratic:
        """A quadratic that touches minus the log density at weights (E,N) from above."""
        ...


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of the face's surface as a dense network finds them beside the 68 landmarks.

    Args:
        points: (I,P,2) pixels; NaN for missing.
        deviations: standard deviations of a coordinate as they are stated, (I,P) pixels.
        sites: where they lie on the rig's mesh, P of them.
    """

    points: Tensor
    deviations: Tensor
    sites: Attachment


@dataclass(frozen=True)
class FitSettings:
    """The noise of landmarks, the priors on faces, and what is made of them.

    Args:
        inner_weight: of a squared error at brows, eyes, nose and mouth beside one at the contour.
        contour_slide: how much less an error along the face's contour counts than one across it, 0 to 1; 1 takes
            contour landmarks as points.
        sliding: contour landmarks of the far side move to the visible silhouette, as people and detectors mark them;
            False where they are vertices that may be hidden. Absent, what fits better is taken.
        deviations: what each landmark is expected to be off by, (I,68) pixels: they count beside their view's
            median, from half to four times it. All alike if absent.
        surface: further points of the face; with them errors of neighbours are taken to go together.
        annotated: landmarks lie where annotators put them, and what learns from them, rather than on the heads'
            vertices; see ``as_annotated`` and ``annotated_vertices``.
        expression_prior: which weights of the rig's shapes go together, in place of the mean and the ridge below.
        sparsity: beside that prior, for a weight of 1.
        expression_mean: how strong a shape is on average, in weights; the prior falls exponentially.
        expression_ridge: prior deviation of a weight beside that.
        asymmetry: prior deviation of the difference between a shape's weight and its mirror image's. Faces move almost
            alike on both sides, and 68 landmarks of a rotated head hardly distinguish a lopsided smile from it.
        one_expression: all photographs show the same one, as taken at once; else each has its own.
        identity_bound: on each coefficient, standard deviations.
        unknown_deviation: of a coordinate, millimetres: smooth differences of heads that the model does not know, on
            average; how large this person's are is estimated. 0 holds heads to the model.
        noise: of an inner landmark, pixels; estimated from the residuals if absent.
        focal_deviation: relative deviation of the true focal length from the given one; 0 takes it as exact.
        shared_focal: one focal length for all photographs.
        max_iterations: of Gauss-Newton.
        transfers: how often shapes are transferred to the head found; 0 keeps the template's.
        texture_size: of the skin, texels a side; 0 makes no texture.
        irises: centres of the irises in each photograph, (I,2,2) pixels, NaN where unknown: their colour is there.
        parts: what each photograph shows, skin, hair, hands: skin and the face's features alone are projected onto the
            head; all of it if absent.

    Raises:
        ValueRangeError: a setting is NaN, infinite or out of its range.
        ShapeError: deviations of another shape.

    Example:
        >>> FitSettings(focal_deviation=0.05, shared_focal=True).identity_bound
        3.0
    """

    inner_weight: float = 2.0
    contour_slide: float = 0.5
    sliding: bool | None = None
    deviations: Tensor | None = None
    surface: SurfacePoints | None = None
    annotated: bool = False
    expression_prior: ExpressionPrior | None = None
    sparsity: float = 1.0
    expression_mean: float = 0.2
    expression_ridge: float = 0.5
    asymmetry: float = 0.1
    one_expression: bool = False
    identity_bound: float = 3.0
    unknown_deviation: float = 1.0
    noise: float | None = None
    focal_deviation: float = 0.0
    shared_focal: bool = True
    max_iterations: int = 20
    transfers: int = 1
    texture_size: int = 1024
    irises: Tensor | None = None
    parts: Sequence[FaceParts] | None = None

    def __post_init__(self) -> None:
        for name in ("inner_weight", "expression_mean", "expression_ridge", "asymmetry", "identity_bound"):
            checked_number(name, getattr(self, name), 0.0, LARGEST_WEIGHT, above=True)
        if self.deviations is not None and self.deviations.shape[1:] != (LANDMARKS,):
            raise ShapeError(f"deviations: found {tuple(self.deviations.shape)}, expected (I,{LANDMARKS})")
        if self.noise is not None:
            checked_number("noise", self.noise, above=True)
        checked_number("contour_slide", self.contour_slide, 0.0, 1.0)
        for name in ("focal_deviation", "sparsity", "unknown_deviation"):
            checked_number(name, getattr(self, name))
        checked_count("max_iterations", self.max_iterations, 1)
        checked_count("transfers", self.transfers)
        checked_count("texture_size", self.texture_size, 0, MAX_SIDE)


@dataclass(frozen=True, eq=False)
class Problem:
    """What is looked for and where it was seen.

    Args:
        points: landmarks and contour curves as functions of K coefficients of identity and N weights.
        identities: K; the last ``smooth`` of them are differences that the head model does not know.
        found: landmarks and points of the surface, (I,68+P,2), NaN for missing.
        focal: the expected focal lengths, (I,), pixels.
        settings: see there.
        twins: rows of shapes that mirror each other, (P,2); none if absent.
        smooth: see ``smooth_differences``.
    """

    points: LinearPoints
    identities: int
    found: Tensor
    focal: Tensor
    settings: FitSettings
    twins: Tensor | None = None
    smooth: int = 0

    @property
    def seen(self) -> Tensor:
        """Which landmarks and points are there, (I,68+P) bool."""
        return torch.isfinite(self.found).all(-1)

    @property
    def targets(self) -> Tensor:
        """The landmarks with zeros for missing ones."""
        return torch.where(self.seen[..., None], self.found, 0.0)

    @property
    def least_noise(self) -> float:
        """Of an inner landmark, pixels: finders err alike in neighbours, which their residuals do not show."""
        least = _MIN_NOISE * float(self.focal.mean())
        if not self.settings.annotated:
            return least
        if self.settings.surface is not None and self.settings.deviations is not None:
            return max(least, _STATED_68 * float(_typical(self.settings.deviations).mean()))
        eyes = (self.found[:, 36] - self.found[:, 45]).norm(dim=-1)
        return max(least, _FOUND_NOISE * float(eyes.nan_to_num(0.0).mean()))

    @cached_property
    def mixing(self) -> Tensor | None:
        """See ``Whitening``; of the points that are there."""
        if self.settings.surface is None:
            return None
        places = self.points.mean[: self.points.count]
        alike = _TOGETHER * (-torch.cdist(places, places) / _ALIKE_OVER).exp()
        alike.diagonal().fill_(1.0)
        both = self.seen[:, :, None] & self.seen[:, None]
        alike = torch.where(both, alike, torch.eye(len(places), dtype=alike.dtype))
        one = torch.eye(len(places), dtype=alike.dtype).expand_as(alike)
        return torch.linalg.solve_triangular(torch.linalg.cholesky(alike), one, upper=False)

    @property
    def expressions(self) -> int:
        """How many there are, E: one a view, or one for all."""
        return 1 if self.settings.one_expression else len(self.found)

    @property
    def unknowns(self) -> int:
        """D, of identity and all expressions: K + E N."""
        k = self.identities
        return k + self.expressions * (len(self.points.basis) - k)

    @property
    def rows(self) -> Tensor:
        """Which of the D coefficients each view's face follows, (I,K+N)."""
        k, count = self.identities, len(self.points.basis) - self.identities
        first = k + count * torch.arange(self.expressions)
        own = (first[:, None] + torch.arange(count)).expand(len(self.found), count)
        return torch.cat([torch.arange(k).expand(len(own), k), own], dim=1)

    def weights(self, coefficients: Tensor) -> Tensor:
        """The expressions (E,N) among coefficients (D,)."""
        return coefficients[self.identities :].unflatten(0, (self.expressions, -1))

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper, (D,)."""
        lower, upper = (make(self.unknowns, dtype=torch.float64) for make in (torch.zeros, torch.ones))
        k = self.identities
        lower[:k], upper[:k] = -self.settings.identity_bound, self.settings.identity_bound
        return lower, upper

    def prior(self, state: State) -> tuple[Tensor, Tensor]:
        """Of the energy ½ xᵀ P x + βᵀ x: P (D,D) and β (D,); it touches that of the expressions at the state."""
        weights, k = self.weights(state.coefficients), self.identities
        count, settings = weights.shape[1], self.settings
        precision, linear = (
            torch.zeros(*shape, dtype=torch.float64) for shape in ((self.unknowns,) * 2, (self.unknowns,))
        )
        precision.diagonal()[:k] = 1.0
        precision.diagonal()[k - self.smooth : k] = 1 / state.unknown
        if settings.expression_prior is None:
            own = torch.eye(count, dtype=torch.float64) / settings.expression_ridge**2
            each, pull = own.expand(len(weights), -1, -1), torch.full_like(weights, 1 / settings.expression_mean)
        else:
            energy = settings.expression_prior.energy(weights)
            each, pull = energy.H.expand(len(weights), -1, -1), energy.f + settings.sparsity
        if self.twins is not None and len(self.twins):
            rows = torch.arange(len(self.twins))
            apart = torch.zeros(len(self.twins), count, dtype=torch.float64)
            apart[rows, self.twins[:, 0]], apart[rows, self.twins[:, 1]] = 1.0, -1.0
            each = each + apart.T @ apart / settings.asymmetry**2
        linear[k:] = pull.flatten()
        precision[k:, k:] = torch.block_diag(*each)
        return precision, linear


@dataclass(frozen=True, eq=False)
class State:
    """Where the solve stands.

    Args:
        coefficients: (D,).
        views: the cameras.
        rows: which point each landmark is, (I,68).
        noise: of an inner landmark, pixels.
        unknown: the variance of differences that the head model does not know, in what is expected of them.
    """

    coefficients: Tensor
    views: Views
    rows: Tensor
    noise: float
    unknown: float = 1.0


@dataclass(frozen=True, eq=False)
class Normal:
    """The normal equations after the cameras are eliminated, and what brings them back.

    Args:
        H: of the coefficients, (D,D), without the prior.
        g: (D,).
        rows: of each view's coefficients, (I,K+N).
        focal_back, focal_alone: the step of the focal lengths for one of the coefficients, (F,D), and at none, (F,).
        pose_back, pose_alone: that of a view's pose for its coefficients and its focal length, (I,6,K+N+1), and at
            none, (I,6).
    """

    H: Tensor
    g: Tensor
    rows: Tensor
    focal_back: Tensor
    focal_alone: Tensor
    pose_back: Tensor
    pose_alone: Tensor

    @property
    def cameras(self) -> int:
        """How many unknowns they have."""
        return self.pose_alone.numel() + len(self.focal_alone)

    def cameras_step(self, change: Tensor, focal: Tensor) -> tuple[Tensor, Tensor]:
        """Steps of poses (I,6) and of focal lengths' logarithms (I,) for a change (D,); focal as of ``step_focal``."""
        longer = focal @ (self.focal_alone + self.focal_back @ change)
        own = torch.cat([change[self.rows], longer[:, None]], dim=1)
        return self.pose_alone + (self.pose_back @ own[..., None])[..., 0], longer


def whitening(problem: Problem, state: State, picked: PickedPoints) -> Whitening:
    """What makes errors unit and independent: the contour's by whether they lie along or across it."""
    settings = problem.settings
    factors = torch.eye(2, dtype=torch.float64).repeat(*problem.seen.shape, 1, 1)
    line = state.views.pixels(picked.at(state.coefficients[problem.rows]))[:, :JAW]
    along = torch.cat([line[:, 1:2] - line[:, :1], line[:, 2:] - line[:, :-2], line[:, -1:] - line[:, -2:-1]], dim=1)
    along = torch.nn.functional.normalize(along, dim=-1)
    tangent = along[..., :, None] * along[..., None, :]
    factors[:, :JAW] -= (1 - settings.contour_slide) * tangent
    factors[:, :JAW] /= settings.inner_weight**0.5
    if settings.deviations is not None:
        factors /= _relative(settings.deviations, settings.surface)[..., None, None]
    scale = problem.seen / (state.noise * _scales(problem, state.views))[:, None]
    return Whitening(factors * scale[..., None, None], problem.mixing)


def _typical(deviations: Tensor) -> Tensor:
    """The median of each view's deviations (I,68), (I,1)."""
    known = torch.where(deviations.isfinite(), deviations.double(), torch.nan)
    return known.nanmedian(1, keepdim=True).values


def _relative(deviations: Tensor, surface: SurfacePoints | None) -> Tensor:
    """Deviations (I,68) of landmarks beside the median of their view, and those of a surface, (I,68+P)."""
    typical = _typical(deviations)
    landmarks = (deviations.double() / typical).nan_to_num(_MOST, _MOST).clamp(_LEAST, _MOST)
    if surface is None:
        return landmarks
    points = (_STATED_POINTS / _STATED_68) * surface.deviations.double() / typical
    return torch.cat([landmarks, points.nan_to_num(_FAR, _FAR).clamp(_LEAST, _FAR)], dim=1)


def _scales(problem: Problem, views: Views) -> Tensor:
    """How large each view's noise is beside the mean view's, (I,): as the face, where it is not given in pixels."""
    size = views.intrinsics[:, 0, 0] / views.translation[:, 2]
    return size / size.log().mean().exp() if problem.settings.noise is None else torch.ones_like(size)


def step_focal(problem: Problem) -> Tensor:
    """How the unknowns of focal length, F of them, act on the views, (I,F)."""
    count, settings = len(problem.found), problem.settings
    if settings.focal_deviation == 0:
        return torch.zeros(count, 0, dtype=torch.float64)
    if settings.shared_focal:
        return torch.ones(count, 1, dtype=torch.float64)
    return torch.eye(count, dtype=torch.float64)


def normal_equations(problem: Problem, at: Linearised, views: Views) -> Normal:
    """Gauss-Newton's, with the cameras eliminated (Schur complement): poses in each view, then focal lengths."""
    D, focal, rows = problem.unknowns, step_focal(problem), problem.rows
    F = focal.shape[1]
    A = torch.cat([at.by_coefficients, at.by_focal[..., None]], dim=-1).flatten(1, 2)
    B, r = at.by_camera.flatten(1, 2), at.residual.flatten(1)[..., None]
    H_bb = B.mT @ B
    H_bb.diagonal(dim1=1, dim2=2).add_(1e-9 * H_bb.diagonal(dim1=1, dim2=2).clamp(min=1e-12))
    factor = torch.linalg.cholesky(H_bb)
    H_ba = B.mT @ A
    solved = -torch.cholesky_solve(torch.cat([H_ba, B.mT @ r], dim=2), factor)
    pose_back, pose_alone = solved[..., :-1], solved[..., -1]
    own, pull = A.mT @ A + H_ba.mT @ pose_back, (A.mT @ r)[..., 0] + (H_ba.mT @ pose_alone[..., None])[..., 0]
    H, g = torch.zeros(D + F, D + F, dtype=torch.float64), torch.zeros(D + F, dtype=torch.float64)
    for i in range(len(rows)):  # views: each has its own rows
        wide = torch.cat([rows[i], D + focal[i].nonzero()[:, 0]])
        kept = torch.arange(len(wide))
        H[wide[:, None], wide] += own[i][kept[:, None], kept]
        g[wide] += pull[i][kept]
    if not F:
        none = torch.zeros(0, D, dtype=torch.float64)
        return Normal(0.5 * (H + H.T), g, rows, none, none[:, 0], pose_back, pose_alone)
    logs = (views.intrinsics[:, 0, 0] / problem.focal).log()
    precision = 1 / problem.settings.focal_deviation**2
    H.diagonal()[D:] += precision
    g[D:] += precision * ((focal / focal.sum(0)).T @ logs)
    back = -torch.linalg.solve(H[D:, D:], torch.cat([H[D:, :D], g[D:, None]], dim=1))
    reduced = H[:D, :D] + H[:D, D:] @ back[:, :D]
    return Normal(
        0.5 * (reduced + reduced.T),
        g[:D] + H[:D, D:] @ back[:, D],
        rows,
        back[:, :D],
        back[:, D],
        pose_back,
        pose_alone,
    )


def energy(
    problem: Problem, state: State, picked: PickedPoints, factors: Whitening, prior: tuple[Tensor, Tensor]
) -> float:
    """Minus the log posterior up to a constant, at fixed noise, chosen points and quadratic of the prior."""
    precision, linear = prior
    x = state.coefficients
    at = residuals(picked, x[problem.rows], state.views, problem.targets, factors)
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
    factors = replace(whitening(problem, state, picked), mixing=None)
    r = residuals(picked, state.coefficients[problem.rows], state.views, problem.targets, factors).square().sum(-1)
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
    for _ in range(problem.settings.max_iterations):
        x = state.coefficients
        if problem.settings.sliding:
            state = replace(state, rows=chosen_points(problem.points, x[problem.rows], state.views))
        picked = problem.points.picked(state.rows)
        factors = whitening(problem, state, picked)
        at = linearised(picked, x[problem.rows], state.views, problem.targets, factors)
        normal, prior = normal_equations(problem, at, state.views), problem.prior(state)
        low, high = (lower, upper) if free is None else (torch.where(free, lower, x), torch.where(free, upper, x))
        f = normal.g - normal.H @ x + prior[1]
        goal = box_qp(normal.H + prior[0], f[None], low, high, start=x[None])[0]
        before = energy(problem, state, picked, factors, prior)
        state, after = _searched(problem, state, picked, factors, (normal, prior), goal - x, before)
        noise = state.noise
        if problem.settings.noise is None:
            state = _spreads(problem, state, picked, factors, normal)
        # A falling noise changes what the energy weighs: there is more to come.
        if before - after < _DONE * max(abs(before), 1.0) and abs(state.noise - noise) < _SETTLED * noise:
            break
    return state


def _searched(
    problem: Problem,
    state: State,
    picked: PickedPoints,
    factors: Whitening,
    model: tuple[Normal, tuple[Tensor, Tensor]],
    change: Tensor,
    before: float,
) -> tuple[State, float]:
    """The step, halved until the energy falls."""
    normal, prior = model
    motion, longer = normal.cameras_step(change, step_focal(problem))
    for halving in range(_HALVINGS):
        fraction = 0.5**halving
        moved = state.views.moved(fraction * motion, fraction * longer)
        tried = replace(state, coefficients=state.coefficients + fraction * change, views=moved)
        after = energy(problem, tried, picked, factors, prior)
        if after <= before:
            return tried, after
    return state, before


def _spreads(problem: Problem, state: State, picked: PickedPoints, factors: Whitening, normal: Normal) -> State:
    """With noise and unknown differences as large as what is left over and what is found of them, each by what the
    other unknowns cannot explain.

    Source: MacKay 1992 (evidence framework).
    """
    r = residuals(picked, state.coefficients[problem.rows], state.views, problem.targets, factors)
    precision, _ = problem.prior(state)
    posterior = torch.linalg.inv(normal.H + precision)
    used = float((posterior * normal.H).sum()) + normal.cameras  # the trace of (H + P)⁻¹ H
    # A contour landmark that slides constrains hardly more than one number.
    measured = 2 * float(problem.seen.sum()) - (1 - problem.settings.contour_slide) * float(problem.seen[:, :JAW].sum())
    left = max(measured - used, 0.2 * measured)
    deviation = state.noise * (float(r.square().sum()) / left) ** 0.5
    noise = max(deviation, problem.least_noise)
    if not problem.smooth:
        return replace(state, noise=noise)
    some = slice(problem.identities - problem.smooth, problem.identities)
    found = float(state.coefficients[some].square().sum())
    known = problem.smooth - float(posterior.diagonal()[some].sum()) / state.unknown
    unknown = (found + _EXPECTED) / (known + _EXPECTED)
    return replace(state, noise=noise, unknown=min(max(unknown, _LEAST_UNKNOWN), 1.0 / _LEAST_UNKNOWN))


def covariance(problem: Problem, state: State) -> Tensor:
    """Of the coefficients, (D,D), cameras unknown; rows of those that lie on a bound are zero."""
    picked = problem.points.picked(state.rows)
    factors = whitening(problem, state, picked)
    at = linearised(picked, state.coefficients[problem.rows], state.views, problem.targets, factors)
    precision, _ = problem.prior(state)
    H = normal_equations(problem, at, state.views).H + precision
    lower, upper = problem.bounds()
    x = state.coefficients
    inside = ((x > lower + 1e-9) & (x < upper - 1e-9)).nonzero()[:, 0]
    result = torch.zeros_like(H)
    result[inside[:, None], inside] = torch.linalg.inv(H[inside[:, None], inside])
    return result
