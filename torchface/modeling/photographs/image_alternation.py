"""The thesis's own way to a head from photographs, for comparison: poses, identity and expression in turns."""

from __future__ import annotations

from dataclasses import replace

import torch

from torchface.geometry.cameras.pnp import Pose, solve_pnp
from torchface.modeling.photographs.image_solve import Problem, State, whitening
from torchface.modeling.photographs.landmark_view import LANDMARKS, Views, chosen_points, linearised
from torchface.optim import box_qp


def alternate(problem: Problem, state: State, rounds: int = 40) -> State:
    """Poses by PnP, then identity, then expression, each with the others held, ``rounds`` times.

    Focal lengths stay as they are. The energy is that of ``image_solve.solve``, so that only the way to its minimum
    differs.

    Args:
        problem: see there.
        state: where to start.
        rounds: how often.

    Source: thesis 3.2.5, algorithm 2, lines 6 to 8.
    """
    lower, upper = problem.bounds()
    precision, linear = problem.prior()
    weights = torch.ones(LANDMARKS, dtype=torch.float64)
    weights[: len(problem.points.rows)] /= problem.settings.inner_weight
    groups = torch.arange(len(lower)) < problem.identities
    for _ in range(rounds):
        at = problem.points.at(state.coefficients)
        if problem.settings.sliding:
            state = replace(state, rows=chosen_points(problem.points, state.coefficients, state.views))
        views = state.views
        initial = Pose(views.rotation, views.translation, torch.zeros(len(views.rotation)))
        pose = solve_pnp(at[state.rows], problem.found, views.intrinsics, weights, initial)
        views = Views(views.intrinsics, pose.rotation, pose.translation)
        for free in (groups, ~groups):
            picked = problem.points.picked(state.rows)
            state = replace(state, views=views)
            factors = whitening(problem, state, picked)
            lines = linearised(picked, state.coefficients, views, problem.targets, factors)
            A, r = lines.by_coefficients.flatten(0, 2), lines.residual.flatten()
            x, H = state.coefficients, A.T @ A
            low, high = torch.where(free, lower, x), torch.where(free, upper, x)
            found = box_qp(H + precision, (A.T @ r - H @ x + linear)[None], low, high, start=x[None])
            state = replace(state, coefficients=found[0])
    return state
