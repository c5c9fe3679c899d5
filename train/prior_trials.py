"""Trials of a prior on takes that it has not seen: predictions of frames, and solves from a few points."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface import BlendshapeRig
from torchface.capture.own_rig import VideoSettings, VideoSolver
from torchface.capture.priors import DynamicsPrior, ShapePrior, windows_of
from torchface.shape_names import mapping

_FOCAL, _DISTANCE = 900.0, 600.0  # pixels, millimetres
_STILL = 1e-3  # what a weight at rest changes by at most
_LEAST_SHAPES = 0.5  # of those that a rig must know for a trial


@dataclass(frozen=True, eq=False)
class OneStep:
    """Predictions of the frames of held-out takes."""

    errors: Tensor  # (B,N)
    deviations: Tensor  # predicted, (B,N)
    persistence: Tensor  # errors of the last frame as prediction, (B,N)
    extrapolation: Tensor  # errors of the line through the last two frames, (B,N)
    changing: Tensor  # which weights truly change by more than a thousandth, (B,N) bool

    def metrics(self) -> dict[str, float]:
        """Root mean squares in weights, the share of frames within k deviations, the mean negative log likelihood."""
        scaled = self.errors / self.deviations
        metrics = {
            "one-step error": _rms(self.errors),
            "one-step error of persistence": _rms(self.persistence),
            "one-step error of extrapolation": _rms(self.extrapolation),
            "negative log likelihood a weight": float((0.5 * scaled.square() + self.deviations.log()).mean()),
            "root mean square of error by deviation": _rms(scaled),
        }
        for k in (1, 2, 3):
            metrics[f"within {k} deviations"] = float((scaled.abs() < k).double().mean())
        return metrics


def one_step(prior: DynamicsPrior, takes: Sequence[Tensor], noise: float = 0.0) -> OneStep:
    """Predicts every frame of takes (T,N) from the window before it, which noise may have been added to."""
    generator = torch.Generator().manual_seed(0)
    # The extrapolation needs two frames, and all are to be asked for the same ones.
    pairs = [windows_of(take.float(), max(prior.window, 2)) for take in takes]
    windows, following = (torch.cat(parts) for parts in zip(*pairs, strict=True))
    changing = (following - windows[:, -1]).abs() > _STILL
    windows = windows + noise * torch.randn(windows.shape, generator=generator)
    mean, variance = prior(windows)
    last, before = windows[:, -1], windows[:, -2]
    return OneStep(mean - following, variance.sqrt(), last - following, 2 * last - before - following, changing)


@dataclass(frozen=True, eq=False)
class SyntheticVideo:
    """Held-out frames as one camera sees them."""

    rig: BlendshapeRig  # with the shapes of the takes
    intrinsics: Tensor  # of the camera, (3,3), pixels
    landmarks: Tensor  # (B,68,2), pixels, with noise
    rotation: Tensor  # of the head, which no solver is given, (B,3,3)
    truth: Tensor  # the frames' weights, (B,N)


def synthetic_video(
    rig: BlendshapeRig, names: Sequence[str], takes: Sequence[Tensor], pixel_noise: float, frames: int, seed: int = 0
) -> SyntheticVideo | None:
    """Takes (T,N) on a rig whose head nods and turns before a camera of 640 by 480 pixels, so many frames of each.

    None where the rig has no landmarks, or fewer than half of the shapes.
    """
    annotations = rig.neutral.annotations
    landmarks = None if annotations is None else annotations.landmarks
    matrix = mapping(names, rig.names)
    if landmarks is None or float(matrix.any(0).float().mean()) < _LEAST_SHAPES:
        return None
    own = BlendshapeRig(rig.neutral, torch.einsum("rn,rvc->nvc", matrix, rig.deltas), names)
    truth = torch.cat([take[:: max(len(take) // frames, 1)][:frames] for take in takes]).float()
    points = own.vertices[landmarks] + torch.einsum("bn,nlc->blc", truth, own.deltas[:, landmarks])
    center = own.vertices[landmarks].mean(0)
    time = torch.arange(len(truth)) / 25
    angles = torch.stack([0.12 * torch.sin(time), 0.25 * torch.sin(0.7 * time), 0.05 * torch.sin(1.3 * time)], dim=1)
    skew = torch.zeros(len(truth), 3, 3)
    for axis, (row, column) in enumerate(((2, 1), (0, 2), (1, 0))):
        skew[:, row, column], skew[:, column, row] = angles[:, axis], -angles[:, axis]
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0])) @ torch.linalg.matrix_exp(skew)
    seen = (points - center) @ rotation.transpose(1, 2) + torch.tensor([0.0, 0.0, _DISTANCE])
    intrinsics = torch.tensor([[_FOCAL, 0.0, 320.0], [0.0, _FOCAL, 240.0], [0.0, 0.0, 1.0]])
    pixels = _FOCAL * seen[..., :2] / seen[..., 2:] + torch.tensor([320.0, 240.0])
    noise = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(seed))
    return SyntheticVideo(own, intrinsics, pixels + pixel_noise * noise, rotation, truth)


def solve_error(clip: SyntheticVideo, prior: ShapePrior | None, pixel_noise: float) -> float:
    """Root mean square error of weights solved from the landmarks of each frame, the head's pose with them."""
    # The landmarks are projected vertices, so they do not slide.
    settings = VideoSettings(pixel_noise=pixel_noise, contour_slide=1.0)
    solver = VideoSolver(clip.rig, None, clip.intrinsics, prior, settings=settings)
    return _rms(solver(clip.landmarks).weights - clip.truth)


def with_strength(prior: ShapePrior, strength: float) -> ShapePrior:
    """The same prior with another :math:`\\lambda`."""
    other = type(prior).from_config({**prior.config, "strength": strength})
    other.load_state_dict(prior.state_dict())
    return other


def _rms(values: Tensor) -> float:
    return float(values.double().square().mean().sqrt())
