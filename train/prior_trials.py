"""What a prior is worth on takes that it has not seen: predictions of frames, and solves from a few points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface import BlendshapeRig
from torchface.capture.energy import Quadratic
from torchface.capture.priors import DynamicsPrior, ShapePrior, windows_of
from torchface.optim import box_qp
from torchface.shape_names import mapping

_FRAMES = 150  # of each take
_ROUNDS = 6
_LEAST_SHAPES = 0.5  # of those that a rig must know for a trial


@dataclass(frozen=True, eq=False)
class OneStep:
    """Predictions of the frames of held-out takes.

    Args:
        errors: (B,N).
        deviations: predicted, (B,N).
        persistence: errors of the last frame as prediction, (B,N).
        extrapolation: errors of the line through the last two frames, (B,N).
    """

    errors: Tensor
    deviations: Tensor
    persistence: Tensor
    extrapolation: Tensor

    def metrics(self) -> dict[str, float]:
        """Root mean squares in weights, the share of frames within k deviations, the mean negative log likelihood."""
        scaled = self.errors / self.deviations
        found = {
            "one-step error": _rms(self.errors),
            "one-step error of persistence": _rms(self.persistence),
            "one-step error of extrapolation": _rms(self.extrapolation),
            "negative log likelihood a weight": float((0.5 * scaled.square() + self.deviations.log()).mean()),
            "root mean square of error by deviation": _rms(scaled),
        }
        for k in (1, 2, 3):
            found[f"within {k} deviations"] = float((scaled.abs() < k).double().mean())
        return found


def one_step(prior: DynamicsPrior, takes: Sequence[Tensor], noise: float = 0.0, seed: int = 0) -> OneStep:
    """Predicts every frame of takes (T,N) from the window before it, which noise may have been added to."""
    generator = torch.Generator().manual_seed(seed)
    # The extrapolation needs two frames, and all are to be asked for the same ones.
    pairs = [windows_of(take.float(), max(prior.window, 2)) for take in takes]
    windows, following = (torch.cat(parts) for parts in zip(*pairs, strict=True))
    windows = windows + noise * torch.randn(windows.shape, generator=generator)
    mean, variance = prior(windows)
    last, before = windows[:, -1], windows[:, -2]
    return OneStep(mean - following, variance.sqrt(), last - following, 2 * last - before - following)


@dataclass(frozen=True, eq=False)
class Observed:
    """Held-out frames as one camera sees them: 68 points from straight ahead, in units of their noise.

    Args:
        data: of each frame, the energy of the points.
        truth: the frames' weights, (B,N).
        noise: of a point's coordinate, millimetres.
    """

    data: Quadratic
    truth: Tensor
    noise: float


def observed(
    rig: BlendshapeRig, names: Sequence[str], takes: Sequence[Tensor], noise: float, seed: int = 0
) -> Observed | None:
    """Takes as a camera would see them on a rig; None where the rig has no landmarks or too few of the shapes."""
    annotations = rig.neutral.annotations
    landmarks = None if annotations is None else annotations.landmarks
    matrix = mapping(names, rig.names)
    if landmarks is None or float(matrix.any(0).float().mean()) < _LEAST_SHAPES:
        return None
    basis = (matrix.T @ rig.deltas[:, landmarks, :2].flatten(1)).T.double() / noise
    frames = [take[:: max(len(take) // _FRAMES, 1)].double() for take in takes]
    truth = torch.cat(frames)
    generator = torch.Generator().manual_seed(seed)
    seen = truth @ basis.T + torch.randn(len(truth), len(basis), generator=generator, dtype=torch.float64)
    return Observed(Quadratic(basis.T @ basis, -seen @ basis), truth, noise)


def solved(observed: Observed, prior: ShapePrior | None) -> Tensor:
    """Weights (B,N) by the points and a prior: a few rounds, each from the prior's quadratic at the last weights."""
    count = observed.truth.shape[1]
    weights = torch.full_like(observed.truth, 0.05)
    ridge = 1e-3 * torch.eye(count, dtype=torch.float64)
    for _ in range(_ROUNDS if prior is not None else 1):  # each round needs the weights of the one before
        total = observed.data if prior is None else observed.data + prior.energy(weights)
        H = total.H + ridge
        weights = box_qp(H.expand(len(weights), count, count), total.f.expand(len(weights), count))
    return weights


def solve_error(observed: Observed, prior: ShapePrior | None) -> float:
    """Root mean square error of solved weights."""
    return _rms(solved(observed, prior) - observed.truth)


def with_strength(prior: ShapePrior, strength: float) -> ShapePrior:
    """The same prior with another :math:`\\lambda`."""
    other = type(prior).from_config({**prior.config, "strength": strength})
    other.load_state_dict(prior.state_dict())
    return other


def _rms(values: Tensor) -> float:
    return float(values.double().square().mean().sqrt())
