"""Training of the dynamics prior in passes over takes: hyperparameters by gpytorch, the rest in closed form."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.capture.priors.dynamics_prior import DynamicsPrior, DynamicsSettings, UsualMotion
from torchface.capture.priors.gaussian_process import GaussianProcesses
from torchface.capture.priors.motion_features import face_regions, motion_basis, moving_parts
from torchface.capture.priors.motion_noise import MotionNoise
from torchface.capture.priors.process_training import LeftOutProcess, fitted_kernel
from torchface.capture.priors.take_frames import MOST_FRAMES, drawn_rows
from torchface.capture.priors.take_windows import FOLDS, Autoregression, Part, RunningMoments, TakeWindows
from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import checked_type
from torchface.progress import Progress, silent

_MIN_SCALE = 1e-3  # a standard deviation below which a shape counts as one that never moves


@dataclass(frozen=True, eq=False)
class _Steps:
    """What the first pass finds."""

    count: int
    center: Tensor  # mean of the frames that follow them, (N,)
    limits: Tensor  # smallest and largest weight, (2,)
    coefficients: Tensor  # of the autoregression, (J,N)
    left_out: list[Tensor]  # the same from all but each fold


@dataclass(frozen=True, eq=False)
class _Scales:
    """What the second pass finds, and the windows that were drawn."""

    feature: Tensor  # standard deviations of place, slope and curvature, (O,N)
    target: Tensor  # of what the autoregression leaves of a step, (N,)
    moving: Tensor  # root mean squares of the kinds of motion, (K,N)
    inputs: Tensor  # of the windows drawn, scaled, (S,O·N)
    targets: Tensor  # of the same, scaled, (S,N)


def fit_dynamics_prior(
    takes: Sequence[Tensor],
    names: Sequence[str],
    window: int = 4,
    *,
    fps: float = 60.0,
    groups: Sequence[Sequence[int]] | None = None,
    input_noise: float = 0.0,
    settings: DynamicsSettings | None = None,
    progress: Progress | None = None,
) -> DynamicsPrior:
    """See ``DynamicsPrior.fit``."""
    names = tuple(checked_type("names: a name", name, str) for name in names)
    settings = settings or DynamicsSettings()
    regions = tuple(tuple(group) for group in (face_regions(names) if groups is None else groups))
    progress = progress or silent
    _check(takes, names, window, fps, input_noise)
    everything = TakeWindows(takes, window, input_noise, settings.seed)
    generator = torch.Generator().manual_seed(settings.seed)
    steps = _steps(everything, len(names), generator)
    drawn = drawn_rows(steps.count, max(settings.subset, settings.inducing), generator)
    scales = _scales(everything, steps, drawn)
    inducing = scales.inputs[: settings.inducing]
    processes: list[LeftOutProcess] = []
    for number, group in enumerate(regions):
        progress("fitting Gaussian processes", number, len(regions))
        active = torch.zeros_like(scales.feature)
        active[:, list(group)] = 1.0
        some, targets = scales.inputs[: settings.subset], scales.targets[: settings.subset, list(group)]
        kernel = fitted_kernel(some, targets, inducing, active, settings.iterations)
        processes.append(LeftOutProcess(kernel, inducing, len(group), everything.folds))
    for part in everything.parts():
        inputs, targets = _examples(part, steps, scales)[1:]
        for group, process in zip(regions, processes, strict=True):
            process.learn(part.fold, inputs, targets[:, list(group)])
    for process in processes:
        process.settle(max(settings.correlation_time * fps, 1.0))
    progress("fitting the noise")
    noise = _noise(everything, steps, scales, processes, regions, settings)
    weights = [torch.zeros(len(inducing), len(names), dtype=torch.float64) for _ in regions]
    for group, process, row in zip(regions, processes, weights, strict=True):
        row[:, list(group)] = process.posterior.weights
    return (
        DynamicsPrior(
            names,
            window,
            regions,
            GaussianProcesses.stacked(
                [replace(one.posterior, weights=row) for one, row in zip(processes, weights, strict=True)],
                [process.kernel for process in processes],
            ),
            noise,
            UsualMotion(
                center=steps.center,
                coefficients=steps.coefficients,
                feature_scale=scales.feature,
                target_scale=scales.target,
                gain=torch.tensor([process.gain for process in processes], dtype=torch.float64),
                limits=steps.limits,
            ),
            fps=fps,
            input_noise=input_noise,
        )
        .float()
        .eval()
    )


def _steps(everything: TakeWindows, shapes: int, generator: torch.Generator) -> _Steps:
    """The first pass; the generator goes on behind the noise of all windows."""
    regression = Autoregression(shapes, everything.window, everything.folds)
    total, limits, count = torch.zeros(shapes, dtype=torch.float64), torch.tensor([0.0, 1.0]).double(), 0
    for part in everything.parts(generator):
        regression.add(part)
        total += part.following.sum(0)
        count += len(part.following)
        low, high = part.following.aminmax()
        limits = torch.stack([torch.minimum(limits[0], low), torch.maximum(limits[1], high)])
    return _Steps(count, total / count, limits, *regression.coefficients())


def _scales(everything: TakeWindows, found: _Steps, drawn: Tensor) -> _Scales:
    """The second pass; of the windows with the numbers drawn, (S,), it keeps inputs and targets."""
    basis = motion_basis(everything.window)
    feature, target = RunningMoments(), RunningMoments()
    squared = torch.zeros(())
    motions = torch.empty(len(drawn), basis.shape[1], len(found.center), dtype=torch.float64)
    targets = torch.empty(len(drawn), len(found.center), dtype=torch.float64)
    for part in everything.parts():
        motion, steps = _motion(part, found, basis), part.steps(found.coefficients)
        feature.add(motion)
        target.add(steps)
        squared = squared + moving_parts(part.windows, motion).square().sum(0)
        places, rows = part.rows_of(drawn)
        motions[places], targets[places] = motion[rows], steps[rows]
    feature_scale, target_scale = feature.std().clamp(min=_MIN_SCALE), target.std().clamp(min=_MIN_SCALE)
    return _Scales(
        feature_scale,
        target_scale,
        (squared / found.count).sqrt().clamp(min=_MIN_SCALE),
        (motions / feature_scale).flatten(1),
        targets / target_scale,
    )


def _motion(part: Part, found: _Steps, basis: Tensor) -> Tensor:
    return torch.einsum("bjn,jo->bon", part.windows - found.center, basis)


def _examples(part: Part, found: _Steps, scales: _Scales) -> tuple[Tensor, Tensor, Tensor]:
    """Motion (B,O,N) of a part, and what processes learn from: inputs (B,O·N), targets of the fold left out (B,N)."""
    motion = _motion(part, found, motion_basis(part.windows.shape[1]))
    targets = part.steps(found.left_out[part.fold]) / scales.target
    return motion, (motion / scales.feature).flatten(1), targets


def _noise(
    everything: TakeWindows,
    found: _Steps,
    scales: _Scales,
    processes: Sequence[LeftOutProcess],
    regions: tuple[tuple[int, ...], ...],
    settings: DynamicsSettings,
) -> MotionNoise:
    """The last pass: each fold is predicted from the others, and the noise learned from the errors."""
    kept = drawn_rows(found.count, MOST_FRAMES, torch.Generator().manual_seed(settings.seed)).sort().values
    shapes = len(found.center)
    moving = torch.empty(len(kept), *scales.moving.shape, dtype=torch.float64)
    targets, mean, variance = torch.empty(3, len(kept), shapes, dtype=torch.float64)
    for part in everything.parts():
        motion, inputs, own = _examples(part, found, scales)
        places, rows = part.rows_of(kept)
        moving[places], targets[places] = moving_parts(part.windows, motion)[rows], own[rows]
        for group, process in zip(regions, processes, strict=True):
            columns = torch.tensor(group)
            predicted, uncertain = process.predict(part.fold, inputs)
            process.compare(predicted, own[:, columns])
            mean[places[:, None], columns] = predicted[rows]
            variance[places[:, None], columns] = uncertain[rows, None].expand(-1, len(group))
    gain = torch.zeros(shapes, dtype=torch.float64)
    for group, process in zip(regions, processes, strict=True):
        gain[list(group)] = process.gain
    return MotionNoise.fit(
        moving,
        (targets - gain * mean) * scales.target,
        gain.square() * variance * scales.target.square(),
        scales.moving,
        regions,
        settings.floor,
    )


def _check(takes: Sequence[Tensor], names: tuple[str, ...], window: int, fps: float, input_noise: float) -> None:
    wrong = [tuple(take.shape) for take in takes if take.ndim != 2 or take.shape[1] != len(names)]
    if not takes or wrong:
        found = f"takes of {wrong[0]}" if wrong else "no takes"
        raise ShapeError(f"dynamics prior: found {found}, expected (T,{len(names)}) each")
    if window < 1 or not 0 < fps < math.inf or not 0 <= input_noise < math.inf:
        raise ValueRangeError(
            f"dynamics prior: found a window of {window} frames at {fps} a second and an input noise of {input_noise}, "
            "expected at least one frame, a positive rate and a standard deviation that is not negative"
        )
    if len(takes) == 1 and len(takes[0]) < 2 * FOLDS + window:
        raise ShapeError(
            f"dynamics prior: found one take of {len(takes[0])} frames, expected at least {2 * FOLDS + window} "
            f"for a window of {window}"
        )
