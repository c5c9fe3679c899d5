"""Joint Gauss-Newton over identity, expression, poses and focal length, each step a quadratic program in a box."""

from dataclasses import dataclass, replace
from math import log

import torch
from torch import Tensor

from torchface.modeling.photographs.fit_problem import Problem, State, step_focal, whitening
from torchface.modeling.photographs.landmark_view import (
    JAW,
    Linearised,
    PickedPoints,
    Views,
    Whitening,
    chosen_points,
    linearised,
    residuals,
)
from torchface.optim import box_qp

_DONE, _HALVINGS = 1e-5, 6
_SETTLED = 0.02
_LEAST_GAIN = 5.0  # of a log posterior: views from the front alone cannot tell sliding landmarks from fixed ones
_EXPECTED, _LEAST_UNKNOWN = 2.0, 1e-2  # of unknown differences: how many are expected to be as large as expected
# Errors of a network's points along heads' forms, beside those that their spread about one head shows: a person's are
# alike in all pictures (0.88), for networks draw points toward the mean head. Checked by test_likeness.
_ALONG_FORMS = 3.2


@dataclass(frozen=True, eq=False)
class Normal:
    """The normal equations after the cameras are eliminated, and what brings them back."""

    H: Tensor  # of the coefficients, (D,D), without the prior
    g: Tensor  # (D,)
    rows: Tensor  # of each view's coefficients, (I,K+N)
    # focal_back, focal_alone: the step of the focal lengths for one of the coefficients, (F,D), and at none, (F,)
    focal_back: Tensor
    focal_alone: Tensor
    # pose_back, pose_alone: that of a view's pose for its coefficients and its focal length, (I,6,K+N+1), and at none,
    # (I,6)
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
    """``solve``, with sliding contour landmarks or with fixed ones: what makes the landmarks more probable."""
    if problem.settings.sliding is not None:
        return problem, solve(problem, initial)
    sliding, fixed = (replace(problem, settings=replace(problem.settings, sliding=slide)) for slide in (True, False))
    state, other = solve(sliding, initial), solve(fixed, initial)
    if _improbability(fixed, other) < _improbability(sliding, state) - _LEAST_GAIN:
        return fixed, other
    return sliding, state


def _improbability(problem: Problem, state: State) -> float:
    """Minus the log posterior up to a constant, with the noise that was estimated."""
    picked = problem.points.picked(state.rows)
    factors = whitening(problem, state, picked)
    measured = 2 * int(problem.seen.sum())
    return energy(problem, state, picked, factors, problem.prior(state)) + measured * log(state.noise)


def solve(problem: Problem, state: State, free: Tensor | None = None) -> State:
    """Gauss-Newton until nothing changes, of all coefficients or the ``free`` ones, (D,) bool."""
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
    known = problem.smooth - float((posterior.diagonal() * precision.diagonal())[some].sum())
    unknown = (found + _EXPECTED) / (known + _EXPECTED)
    return replace(state, noise=noise, unknown=min(max(unknown, _LEAST_UNKNOWN), 1.0 / _LEAST_UNKNOWN))


def covariance(problem: Problem, state: State) -> Tensor:
    r"""Of the coefficients' errors, (D,D), cameras unknown.

    .. math:: (H + P)^{-1} (s^2 H + P P_0^{-1} P) (H + P)^{-1}

    with the precision P of the prior as the solve weighs it, P_0 that true coefficients have, and errors of points s
    times as large along heads' forms as the solve, of normal matrix H, takes them to be. What lies on a bound is as
    wide as an exponential distribution that falls as steeply as the posterior there: a shape that a photograph seems
    not to show is not known to be absent.
    """
    picked = problem.points.picked(state.rows)
    factors = whitening(problem, state, picked)
    at = linearised(picked, state.coefficients[problem.rows], state.views, problem.targets, factors)
    precision, linear = problem.prior(state)
    normal = normal_equations(problem, at, state.views)
    along = 1.0 if problem.settings.surface is None else _ALONG_FORMS
    weighed = precision.clone()  # P P_0^{-1} P
    weighed.diagonal()[: problem.identities] *= problem.identity_precision
    lower, upper = problem.bounds()
    x = state.coefficients
    slope = normal.g + precision @ x + linear
    steep = torch.where((x > lower + 1e-9) & (x < upper - 1e-9), 0.0, (slope / along**2).square()).diag()
    back = torch.linalg.inv(normal.H + precision + steep)
    return back @ (along**2 * normal.H + weighed + steep) @ back
