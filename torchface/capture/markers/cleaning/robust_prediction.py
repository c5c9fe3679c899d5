"""Where a rig expects each marker in each frame, told from the markers that agree with each other."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.markers.helmet_solver import rigid_columns
from torchface.capture.markers.marker_solver import MarkerSolver, penalty_value
from torchface.optim import BoxQP

# What disagrees by more is left out of the next round, millimetres; then down to the take's own limit.
_FALLING_LIMITS = (20.0, 12.0, 8.0, 6.0, 5.0)
_LAST_ROUNDS, _FIRST_FILLS = 4, 6
_SPREADS, _LEAST_LIMIT = 5.0, 2.0
_LARGEST_SHARE = 2.0
_LARGEST_BIAS = 2.0
_RIDGE, _MOTION_RIDGE = 1e-2, 1e-4
_TOLERANCE = 3e-6


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the rig expects.

    Args:
        expected: where each marker should be, in rig space, (T,M,3), millimetres.
        distance: between seen and expected, (T,M), NaN where not seen.
        limit: the distance beyond which a sample of the marker is off, (M,).
    """

    expected: Tensor
    distance: Tensor
    limit: Tensor

    @property
    def off(self) -> Tensor:
        """Samples that do not fit, (T,M) bool."""
        return self.distance > self.limit


def predict_markers(
    solver: MarkerSolver, seen: Tensor, slip: bool = False, ignored: Tensor | None = None
) -> Prediction:
    """Solves all frames again and again, each time without the samples that were far from what was expected.

    A marker's limit is five times its own median distance, at least two millimetres: a rig that fits the performer
    badly is given more room.

    Args:
        solver: rig, attachment, sparsity.
        seen: markers in rig space, (T,M,3), float64, NaN for not seen.
        slip: the helmet may move; six rigid columns take that up.
        ignored: markers that are predicted from the others alone, (M,) bool.
    """
    rest, columns = solver.rest.double(), solver.basis.double()
    shapes = columns.shape[2]
    lower, upper = rest.new_zeros(shapes), rest.new_ones(shapes)
    ridge, price = rest.new_full((shapes,), 2 * _RIDGE), rest.new_full((shapes,), penalty_value(solver.sparsity))
    if slip:
        columns = torch.cat([columns, rigid_columns(rest, rest.mean(0))], dim=2)
        bound = rest.new_full((6,), torch.inf)
        lower, upper = torch.cat([lower, -bound]), torch.cat([upper, bound])
        ridge = torch.cat([ridge, rest.new_full((6,), 2 * _MOTION_RIDGE)])
        price = torch.cat([price, rest.new_zeros(6)])
    rows = columns.flatten(0, 1)
    share = 2.0 / len(rest)
    qp = BoxQP(share * (rows.T @ rows) + torch.diag(ridge), lower, upper, _TOLERANCE)

    def solve(trusted: Tensor, weights: Tensor, bias: Tensor, passes: int) -> Tensor:
        for _ in range(passes):  # a sample that is not trusted sits where the weights have it: one H for all frames
            expected = rest + bias + (weights @ rows.T).unflatten(1, (-1, 3))
            filled = torch.where(trusted[..., None], seen, expected)
            weights = qp(share * ((rest + bias - filled).flatten(1) @ rows) + price, weights)
        return weights

    visible = ~torch.isnan(seen).any(-1)
    if ignored is not None:
        visible &= ~ignored
    weights, bias = seen.new_zeros(len(seen), columns.shape[2]), torch.zeros_like(rest)
    weights = solve(visible, weights, bias, _FIRST_FILLS)
    limit, distance = rest.new_full((len(rest),), _FALLING_LIMITS[0]), seen.new_zeros(seen.shape[:2])
    for number in range(len(_FALLING_LIMITS) + _LAST_ROUNDS):
        left = seen - rest - (weights @ rows.T).unflatten(1, (-1, 3))
        fits = torch.where((distance <= limit)[..., None], left, torch.nan)
        bias = fits.nanmedian(0).values.nan_to_num(0.0)
        bias = bias * (_LARGEST_BIAS / bias.norm(dim=1, keepdim=True).clamp(min=_LARGEST_BIAS))
        distance = (left - bias).norm(dim=-1)
        usual = torch.where(distance <= limit, distance, torch.nan).nanmedian(0).values.nan_to_num(0.0)
        own = (_SPREADS * usual).clamp(min=_LEAST_LIMIT)
        # The limit of a marker that is off much of the time must not be its own.
        own = torch.minimum(own, _LARGEST_SHARE * own.median())
        if ignored is not None:
            own = torch.where(ignored, torch.minimum(own, own.median()), own)
        ceiling = _FALLING_LIMITS[number] if number < len(_FALLING_LIMITS) else 0.0
        limit = own.clamp(min=ceiling)
        weights = solve(visible & ~(distance > limit), weights, bias, 2)
    expected = rest + bias + (weights @ rows.T).unflatten(1, (-1, 3))
    return Prediction(expected, (seen - expected).norm(dim=-1), limit)
