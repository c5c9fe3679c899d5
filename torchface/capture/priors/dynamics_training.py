"""Training of the dynamics prior in passes over takes: hyperparameters by gpytorch, the rest in closed form."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.capture.priors.dynamics_prior import DynamicsPrior, DynamicsSettings, UsualMotion
from torchface.capture.priors.gaussian_process import (
    GaussianProcesses,
    Kernel,
    Posterior,
    Statistics,
    posterior,
    whitening_of,
)
from torchface.capture.priors.motion_features import face_regions, motion_basis, moving_parts
from torchface.capture.priors.motion_noise import MotionNoise
from torchface.capture.priors.name_translation import checked_names
from torchface.capture.priors.take_frames import MOST_FRAMES, drawn_rows
from torchface.capture.priors.take_windows import FOLDS, Autoregression, Part, RunningMoments, TakeWindows
from torchface.errors import ShapeError, ValueRangeError
from torchface.progress import Progress, silent

_LEARNING_RATE = 0.1
_LEAST_ENERGY = 1e-3  # of a part's targets: one that hardly moves is not to count for more


def fitted_kernel(inputs: Tensor, targets: Tensor, inducing: Tensor, active: Tensor, iterations: int) -> Kernel:
    """Hyperparameters that maximise the bound of the marginal likelihood with inducing points, all targets together.

    One length for places, one for slopes, one for curvatures; by Adam on what gpytorch makes of them so that they stay
    positive.

    Source: Titsias 2009.
    """
    import gpytorch  # takes seconds, and only training needs it
    from linear_operator.utils.warnings import NumericalWarning

    columns = [active[order].nonzero()[:, 0] + order * active.shape[1] for order in range(len(active))]
    used = torch.cat(columns)
    sizes = torch.tensor([len(column) for column in columns]).cumsum(0).tolist()
    product = None
    for stop, column in zip(sizes, columns, strict=True):
        one = gpytorch.kernels.RBFKernel(active_dims=tuple(range(stop - len(column), stop)))
        one.lengthscale = math.sqrt(len(used))
        product = one if product is None else product * one
    scaled = gpytorch.kernels.ScaleKernel(product)
    scaled.outputscale = 0.3
    likelihood = gpytorch.likelihoods.GaussianLikelihood()
    likelihood.noise = 0.7
    points = gpytorch.kernels.InducingPointKernel(scaled, inducing[:, used].clone(), likelihood).double().train()
    points.inducing_points.requires_grad_(False)
    optimizer = torch.optim.Adam(points.parameters(), lr=_LEARNING_RATE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)  # of the jitter that inducing points close by need
        for _ in range(iterations):  # each step needs the one before
            optimizer.zero_grad()
            covariance = points(inputs[:, used]).evaluate_kernel().add_diagonal(likelihood.noise.expand(len(inputs)))
            fit, volume = covariance.inv_quad_logdet(targets, logdet=True)
            missed = sum(term.loss() for term in points.added_loss_terms())
            loss = (0.5 * (fit + targets.shape[1] * volume) - targets.shape[1] * missed) / targets.numel()
            loss.backward()
            optimizer.step()
    lengths = [
        module.lengthscale.item() for module in scaled.base_kernel.modules() if hasattr(module, "raw_lengthscale")
    ]
    inverse = active / torch.tensor(lengths, dtype=active.dtype)[:, None]
    return Kernel(scaled.outputscale.item(), inverse.flatten(), likelihood.noise.item())


class LeftOutProcess:
    """Cross-validation of a process in two passes over parts of a few folds; no frame is kept.

    In the first pass ``learn`` takes each part, then ``settle`` solves; in the second ``predict`` gives what the other
    folds make of a part, and ``compare`` how well. Memory is two matrices a fold.
    """

    posterior: Posterior
    """Of all folds, once settled."""

    def __init__(self, kernel: Kernel, inducing: Tensor, targets: int, folds: int) -> None:
        self.kernel, self._inducing, self._whitening = kernel, inducing, whitening_of(kernel, inducing)
        points = len(inducing)
        self._squares = torch.zeros(folds, points, points, dtype=torch.float64)
        self._products = torch.zeros(folds, points, targets, dtype=torch.float64)
        self._others: list[Posterior] = []
        self._toward = self._length = 0.0

    def learn(self, fold: int, inputs: Tensor, targets: Tensor) -> None:
        """Takes up a part: inputs (B,F), and targets (B,n) under autoregression coefficients of the other folds."""
        features = self.kernel.between(inputs, self._inducing) @ self._whitening
        self._squares[fold].addmm_(features.T, features)
        self._products[fold].addmm_(features.T, targets)

    def settle(self, redundancy: float) -> None:
        """Solves for all folds, and for all but each; the number of correlated frames that count as one is given."""
        whole = Statistics(self._squares.sum(0), self._products.sum(0))

        def solved(statistics: Statistics) -> Posterior:
            return posterior(self.kernel, self._inducing, self._whitening, statistics, redundancy)

        self.posterior = solved(whole)
        self._others = [
            solved(Statistics(whole.square - square, whole.product - product))
            for square, product in zip(self._squares, self._products, strict=True)
        ]

    def predict(self, fold: int, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (B,n) and variance (B,), without noise, of inputs (B,F) of a fold, learned from the others."""
        near, own = self.kernel.between(inputs, self._inducing), self._others[fold]
        projected = near @ own.covariance_root
        explained = (near @ self._whitening).square().sum(1)
        return projected @ own.weights, (self.kernel.signal - explained).clamp(min=0.0) + projected.square().sum(1)

    def compare(self, mean: Tensor, targets: Tensor) -> None:
        """Counts how far a predicted mean goes toward the targets of a part, (B,n) both.

        Errors count relative to those without the process, so that a take with much motion does not dominate.
        """
        energy = max(float(targets.square().sum()), _LEAST_ENERGY)
        self._toward += float((mean * targets).sum()) / energy
        self._length += float(mean.square().sum()) / energy

    @property
    def gain(self) -> float:
        """By what the mean is best multiplied, in [0,1], of all that was compared."""
        return min(max(self._toward / max(self._length, 1e-12), 0.0), 1.0)


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
    names = checked_names(names)
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
    if not len(takes) or wrong:
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
