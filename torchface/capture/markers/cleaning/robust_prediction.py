"""The expected place of each marker in each frame: a robust solve from the markers that agree with each other."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.markers.frame_poses import frame_poses
from torchface.capture.markers.helmet_motion import rigid_columns
from torchface.capture.markers.marker_solver import MarkerSolver, penalty_value
from torchface.capture.markers.rest_pose import sample_limits
from torchface.optim import BoxQP
from torchface.optim.box_checks import default_tolerance

# Samples with a larger residual are left out of the next iteration, mm; then the take's own limit counts.
_ANNEALED_LIMITS = (20.0, 12.0, 8.0, 6.0, 5.0)
_LAST_ITERATIONS, _FIRST_FILL_ITERATIONS = 4, 6
_MAX_BIAS = 2.0
_RIDGE, _MOTION_RIDGE = 1e-2, 1e-4


@dataclass(frozen=True, eq=False)
class Prediction:
    """The markers as the rig predicts them."""

    expected: Tensor  # where each marker should be, in rig space, (T,M,3), millimetres
    distance: Tensor  # between seen and expected, (T,M), NaN where not seen
    limit: Tensor  # the distance beyond which a sample of the marker is an outlier, (M,)

    @property
    def outliers(self) -> Tensor:
        """Samples that do not fit, (T,M) bool."""
        return self.distance > self.limit


def predict_markers(
    solver: MarkerSolver, seen: Tensor, slip: bool = False, ignored: Tensor | None = None
) -> Prediction:
    """Solves all frames iteratively, each time without the samples that were far from their prediction.

    A marker's limit is five times its own median distance, at least two millimetres: a rig that fits the performer
    badly gets larger limits.

    Args:
        seen: markers in rig space, (T,M,3), float64, NaN for not seen.
        slip: the helmet may move: by a rigid motion a frame, and six rigid columns for what outliers moved that.
        ignored: markers that are predicted from the others alone, (M,) bool.
    """
    rest, columns = solver.rest.double(), solver.every_basis.double()
    shapes = columns.shape[2]
    lower, upper = rest.new_zeros(shapes), rest.new_ones(shapes)
    ridge, penalty = rest.new_full((shapes,), 2 * _RIDGE), rest.new_full((shapes,), penalty_value(solver.sparsity))
    pose = None
    if slip:
        affine = torch.cat([rest[..., None], columns], dim=2)
        pose = frame_poses(affine, seen, rest.new_ones(()), _RIDGE)[1]
        seen = pose.apply(seen)
        columns = torch.cat([columns, rigid_columns(rest, rest.mean(0))], dim=2)
        bound = rest.new_full((6,), torch.inf)
        lower, upper = torch.cat([lower, -bound]), torch.cat([upper, bound])
        ridge = torch.cat([ridge, rest.new_full((6,), 2 * _MOTION_RIDGE)])
        penalty = torch.cat([penalty, rest.new_zeros(6)])
    rows = columns.flatten(0, 1)
    scale = 2.0 / len(rest)
    qp = BoxQP(scale * (rows.T @ rows) + torch.diag(ridge), lower, upper, default_tolerance(torch.float32))

    def solve(inlier: Tensor, weights: Tensor, bias: Tensor, passes: int) -> Tensor:
        for _ in range(passes):  # outliers are filled in by the weights: one H for all frames
            expected = rest + bias + (weights @ rows.T).unflatten(1, (-1, 3))
            filled = torch.where(inlier[..., None], seen, expected)
            weights = qp(scale * ((rest + bias - filled).flatten(1) @ rows) + penalty, weights)
        return weights

    visible = ~torch.isnan(seen).any(-1)
    if ignored is not None:
        visible &= ~ignored
    weights, bias = seen.new_zeros(len(seen), columns.shape[2]), torch.zeros_like(rest)
    weights = solve(visible, weights, bias, _FIRST_FILL_ITERATIONS)
    limit, distance = rest.new_full((len(rest),), _ANNEALED_LIMITS[0]), seen.new_zeros(seen.shape[:2])
    for number in range(len(_ANNEALED_LIMITS) + _LAST_ITERATIONS):
        residual = seen - rest - (weights @ rows.T).unflatten(1, (-1, 3))
        fits = torch.where((distance <= limit)[..., None], residual, torch.nan)
        bias = fits.nanmedian(0).values.nan_to_num(0.0)
        bias = bias * (_MAX_BIAS / bias.norm(dim=1, keepdim=True).clamp(min=_MAX_BIAS))
        distance = (residual - bias).norm(dim=-1)
        own = sample_limits(torch.where(distance <= limit, distance, torch.nan))
        if ignored is not None:
            own = torch.where(ignored, torch.minimum(own, own.median()), own)
        ceiling = _ANNEALED_LIMITS[number] if number < len(_ANNEALED_LIMITS) else 0.0
        limit = own.clamp(min=ceiling)
        weights = solve(visible & ~(distance > limit), weights, bias, 2)
    expected = rest + bias + (weights @ rows.T).unflatten(1, (-1, 3))
    distance = (seen - expected).norm(dim=-1)
    return Prediction(expected if pose is None else pose.inverse().apply(expected), distance, limit)
