"""Training of the dynamics prior: hyperparameters by gpytorch, the rest in closed form on takes left out in turn."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.capture.priors.dynamics_prior import DynamicsPrior, DynamicsSettings
from torchface.capture.priors.gaussian_process import (
    GaussianProcesses,
    Kernel,
    Posterior,
    Statistics,
    posterior,
    whitening_of,
)
from torchface.capture.priors.motion_features import face_regions, motion_basis, moving_parts, windows_of
from torchface.capture.priors.motion_noise import MotionNoise
from torchface.errors import ShapeError, ValueRangeError
from torchface.progress import Progress, silent

_FOLDS = 4  # of a single take
_LEARNING_RATE = 0.1
_RIDGE = 1e-6  # of the coefficients, in squared weights
_POOLING = 0.02  # weight of the coefficients that all shapes share against each one's own
_MIN_SCALE = 1e-3  # a standard deviation below which a shape counts as one that never moves


@dataclass(frozen=True, eq=False)
class _Part:
    """What is left out together: a take, or a quarter of one.

    Args:
        windows: (B,J,N), with the noise that the prior should expect.
        following: (B,N).
    """

    windows: Tensor
    following: Tensor

    def steps(self, coefficients: Tensor) -> Tensor:
        """The step to the next frame less what the shapes' own frames predict, (B,N)."""
        return self.following - self.windows[:, -1] - (self.windows * coefficients).sum(1)


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
    """Learns from takes, with cross-validation over takes that are left out in turn.

    The kernels' hyperparameters maximise the bound of the marginal likelihood (``gpytorch``). The gain of
    the processes and the noise are those that predict left-out takes best; of a single take its quarters are left out.

    Args:
        takes: weights of each take, (T,N), all at one frame rate (see ``resampled``); windows with a NaN are left
            out.
        names: of the N shapes.
        window: J, at least 1.
        fps: frames a second of the takes.
        groups: :func:`face_regions` if absent.
        input_noise: standard deviation of noise that is added to the windows, not to what follows them: a prior
            for windows of solved weights should expect as much noise as these have, or it keeps their errors.
        settings: of the learning.
        progress: called with each step and how far it is.

    Raises:
        ShapeError: no takes, of another number of shapes, or too short for the window.
        ValueRangeError: no window without a NaN, or a setting out of range.

    Source: thesis 4.2.10 and the appendix "Learning the prior".

    Example:
        >>> take = torch.linspace(0, 12, 120).sin()[:, None].square()
        >>> quick = DynamicsSettings(inducing=8, subset=60, iterations=2)
        >>> prior = fit_dynamics_prior([take], ["jawOpen"], window=2, settings=quick).double()
        >>> rising = take[10:12].double()
        >>> bool(prior(rising[None])[0] > rising[-1])
        True
    """
    names, settings = tuple(names), settings or DynamicsSettings()
    regions = tuple(tuple(group) for group in (face_regions(names) if groups is None else groups))
    progress = progress or silent
    _check(takes, names, window, fps, input_noise)
    generator = torch.Generator().manual_seed(settings.seed)
    parts = _parts(takes, window, input_noise, generator)
    frames = torch.cat([part.following for part in parts])
    center = frames.mean(0)
    basis = motion_basis(window)
    motions = [torch.einsum("bjn,jo->bon", part.windows - center, basis) for part in parts]
    feature_scale = torch.cat(motions).std(0).clamp(min=_MIN_SCALE)
    coefficients, left_out = _autoregression(parts)
    target_scale = torch.cat([part.steps(coefficients) for part in parts]).std(0).clamp(min=_MIN_SCALE)
    steps = torch.cat([part.steps(coefficients) for part in parts]) / target_scale
    unseen = [part.steps(own) / target_scale for part, own in zip(parts, left_out, strict=True)]
    inputs = [(motion / feature_scale).flatten(1) for motion in motions]
    everything = torch.cat(inputs)
    order = torch.randperm(len(everything), generator=generator)
    inducing, some = everything[order[: settings.inducing]], order[: settings.subset]
    kernels: list[Kernel] = []
    chosen: list[CrossValidated] = []
    for number, group in enumerate(regions):
        progress("fitting Gaussian processes", number, len(regions))
        active = torch.zeros_like(feature_scale)
        active[:, list(group)] = 1.0
        kernels.append(
            fitted_kernel(everything[some], steps[some][:, list(group)], inducing, active, settings.iterations)
        )
        targets = [part[:, list(group)] for part in unseen]
        chosen.append(
            cross_validated(kernels[-1], inducing, inputs, targets, max(settings.correlation_time * fps, 1.0))
        )
    progress("fitting the noise")
    process_mean, process_variance = torch.zeros_like(steps), torch.zeros_like(steps)
    weights = [torch.zeros(len(inducing), len(names), dtype=torch.float64) for _ in regions]
    for group, one, row in zip(regions, chosen, weights, strict=True):
        process_mean[:, list(group)], process_variance[:, list(group)] = one.mean, one.variance[:, None]
        row[:, list(group)] = one.posterior.weights
    moving = torch.cat([moving_parts(part.windows, motion) for part, motion in zip(parts, motions, strict=True)])
    noise = MotionNoise.fit(
        moving,
        (torch.cat(unseen) - process_mean) * target_scale,
        process_variance * target_scale.square(),
        moving.square().mean(0).sqrt().clamp(min=_MIN_SCALE),
        regions,
        settings.floor,
    )
    return (
        DynamicsPrior(
            names,
            window,
            regions,
            GaussianProcesses.stacked(
                [replace(one.posterior, weights=row) for one, row in zip(chosen, weights, strict=True)], kernels
            ),
            noise,
            center=center,
            coefficients=coefficients,
            feature_scale=feature_scale,
            target_scale=target_scale,
            gain=torch.tensor([one.gain for one in chosen], dtype=torch.float64),
            limits=torch.stack([frames.min().clamp(max=0.0), frames.max().clamp(min=1.0)]),
            fps=fps,
            input_noise=input_noise,
        )
        .float()
        .eval()
    )


def fitted_kernel(inputs: Tensor, targets: Tensor, inducing: Tensor, active: Tensor, iterations: int) -> Kernel:
    """Hyperparameters that maximise the bound of the marginal likelihood with inducing points, all targets together.

    One length for places, one for slopes, one for curvatures; by Adam on what gpytorch makes of them so that they stay
    positive.

    Args:
        inputs: (B,O·N), scaled.
        targets: (B,n), scaled.
        inducing: (M,O·N).
        active: 1 for inputs that the kernel uses, else 0, (O,N).
        iterations: of Adam.

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
    lengths = [one.lengthscale.item() for one in scaled.base_kernel.modules() if hasattr(one, "raw_lengthscale")]
    inverse = active / torch.tensor(lengths, dtype=active.dtype)[:, None]
    return Kernel(scaled.outputscale.item(), inverse.flatten(), likelihood.noise.item())


@dataclass(frozen=True, eq=False)
class CrossValidated:
    """A process learned from all parts, and its predictions of each part when learned from the others.

    Args:
        posterior: of all parts.
        gain: by what its mean is multiplied, in [0,1].
        mean: of the parts left out, gain included, (B,n).
        variance: of the same, without noise, (B,).
    """

    posterior: Posterior
    gain: float
    mean: Tensor
    variance: Tensor


def cross_validated(
    kernel: Kernel, inducing: Tensor, inputs: Sequence[Tensor], targets: Sequence[Tensor], redundancy: float
) -> CrossValidated:
    """Learns a process, and its gain from the predictions of parts left out in turn.

    Args:
        kernel: of the process.
        inducing: (M,F).
        inputs: of each part, (B,F).
        targets: of each part, under autoregression coefficients learned from the other parts, (B,n).
        redundancy: number of correlated frames that count as one independent frame.
    """
    whitening = whitening_of(kernel, inducing)
    near = [kernel.between(part, inducing) for part in inputs]
    features = [part @ whitening for part in near]
    statistics = [Statistics(f.T @ f, f.T @ t) for f, t in zip(features, targets, strict=True)]
    means, variances = [], []
    for i, (k, f) in enumerate(zip(near, features, strict=True)):
        own = posterior(kernel, inducing, whitening, _summed(statistics[:i] + statistics[i + 1 :]), redundancy)
        projected = k @ own.covariance_root
        means.append(projected @ own.weights)
        variances.append((kernel.signal - f.square().sum(1)).clamp(min=0.0) + projected.square().sum(1))
    mean, target = torch.cat(means), torch.cat(list(targets))
    # Errors count relative to those without the process, so that a take with much motion does not dominate.
    weight = torch.cat([(1 / t.square().sum().clamp(min=_MIN_SCALE)).expand(len(t), 1) for t in targets])
    gain = float(((weight * mean * target).sum() / (weight * mean.square()).sum().clamp(min=1e-12)).clamp(0, 1))
    whole = posterior(kernel, inducing, whitening, _summed(statistics), redundancy)
    return CrossValidated(whole, gain, gain * mean, gain**2 * torch.cat(variances))


def _autoregression(parts: Sequence[_Part]) -> tuple[Tensor, list[Tensor]]:
    """Each shape's step from its own frames, (J,N): by least squares from all parts, and from all but each.

    A window at rest must stay at rest whatever the weights there, so the step is a linear function of the steps before:
    a shape that the takes never raised must not be drawn back to 0. The coefficients are pooled: each shape's are drawn
    toward those that fit all shapes.
    """
    squares, products = [], []
    for part in parts:
        before = part.windows.diff(dim=1)
        squares.append(torch.einsum("bin,bjn->nij", before, before))
        products.append(torch.einsum("bin,bn->ni", before, part.following - part.windows[:, -1]))
    square, product = torch.stack(squares).sum(0), torch.stack(products).sum(0)
    solved = [
        _from_steps(square - a, product - b)
        for a, b in [(torch.zeros_like(square), torch.zeros_like(product)), *zip(squares, products, strict=True)]
    ]
    return solved[0], solved[1:]


def _from_steps(square: Tensor, product: Tensor) -> Tensor:
    """Coefficients (J,N) of frames, of normal equations (N,J-1,J-1), (N,J-1) of the steps between them."""
    count, steps = product.shape
    ridge = _RIDGE * torch.eye(steps, dtype=torch.float64)
    pooled = square.mean(0) + ridge
    common = torch.linalg.solve(pooled, product.mean(0))
    own = torch.linalg.solve(square + _POOLING * pooled, product + _POOLING * (pooled @ common))
    zero = torch.zeros(count, 1, dtype=torch.float64)
    padded = torch.cat([zero, own, zero], dim=1)
    return (padded[:, :-1] - padded[:, 1:]).T


def _parts(takes: Sequence[Tensor], window: int, input_noise: float, generator: torch.Generator) -> list[_Part]:
    """Windows of each take; of a single take those of its quarters."""
    pairs = [windows_of(take.detach().double().cpu(), window) for take in takes]
    if len(pairs) == 1:
        pairs = list(zip(*(part.chunk(_FOLDS) for part in pairs[0]), strict=True))
    return [
        _Part(windows + input_noise * torch.randn(windows.shape, generator=generator, dtype=torch.float64), following)
        for windows, following in pairs
    ]


def _summed(statistics: Sequence[Statistics]) -> Statistics:
    total = statistics[0]
    for one in statistics[1:]:
        total = total + one
    return total


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
    if len(takes) == 1 and len(takes[0]) < 2 * _FOLDS + window:
        raise ShapeError(
            f"dynamics prior: found one take of {len(takes[0])} frames, expected at least {2 * _FOLDS + window} "
            f"for a window of {window}"
        )
