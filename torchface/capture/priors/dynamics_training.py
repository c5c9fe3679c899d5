"""Learning how weights go on: hyperparameters by gpytorch, the rest in closed form on takes left out in turn."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchface.capture.priors.dynamics_prior import DynamicsPrior, DynamicsSettings
from torchface.capture.priors.gaussian_process import (
    Evidence,
    GaussianProcesses,
    Kernel,
    Posterior,
    posterior,
    whitening_of,
)
from torchface.capture.priors.motion_features import face_regions, motion_basis, moving_parts, windows_of
from torchface.capture.priors.motion_noise import MotionNoise
from torchface.errors import ShapeError, ValueRangeError
from torchface.files.extra_packages import import_extra

_FOLDS = 4  # of a single take
_STEP = 0.1  # of Adam
_RIDGE = 1e-6  # of the coefficients, in squared weights
_COMMON = 0.02  # how much of what is common to the shapes each one's own coefficients are learned with
_SMALLEST = 1e-3  # a usual size below which a shape counts as one that never moves


def import_gpytorch() -> Any:
    """The ``gpytorch`` package.

    Raises:
        MissingExtraError: it is not installed.
    """
    return import_extra("gpytorch", "gpytorch", "train", "learning dynamics")


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
        """What the shapes' own frames do not tell of the step to the next frame, (B,N)."""
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
    progress: Callable[[str], None] | None = None,
) -> DynamicsPrior:
    """Learns from takes; what cannot be known from a take itself is judged on takes left out in turn.

    The kernels' hyperparameters maximise the bound of the marginal likelihood (``gpytorch``). How far the
    processes are trusted, and the noise, are such that takes that were left out are predicted best; of a single
    take its quarters are left out.

    Args:
        takes: weights of each take, (T,N), all at one frame rate (see ``resampled``); windows with a NaN are left
            out.
        names: of the N shapes.
        window: J, at least 1.
        fps: frames a second of the takes.
        groups: :func:`face_regions` if absent.
        input_noise: standard deviation of noise that is added to the windows, not to what follows them: a prior
            for windows of solved weights should expect as much noise as these have, or it locks their errors in.
        settings: of the learning.
        progress: told what is being done.

    Raises:
        ShapeError: no takes, of another number of shapes, or too short for the window.
        ValueRangeError: no window without a NaN, or a setting out of range.
        MissingExtraError: gpytorch is not installed.

    Source: thesis 4.2.10 and the appendix "Learning the prior".
    """
    names, settings = tuple(names), settings or DynamicsSettings()
    regions = tuple(tuple(group) for group in (face_regions(names) if groups is None else groups))
    say = progress or (lambda line: None)
    import_gpytorch()
    _check(takes, names, window, fps, input_noise)
    generator = torch.Generator().manual_seed(settings.seed)
    parts = _parts(takes, window, input_noise, generator)
    frames = torch.cat([part.following for part in parts])
    center = frames.mean(0)
    basis = motion_basis(window)
    motions = [torch.einsum("bjn,jo->bon", part.windows - center, basis) for part in parts]
    feature_scale = torch.cat(motions).std(0).clamp(min=_SMALLEST)
    coefficients, left_out = _own_coefficients(parts)
    target_scale = torch.cat([part.steps(coefficients) for part in parts]).std(0).clamp(min=_SMALLEST)
    steps = torch.cat([part.steps(coefficients) for part in parts]) / target_scale
    unseen = [part.steps(own) / target_scale for part, own in zip(parts, left_out, strict=True)]
    inputs = [(motion / feature_scale).flatten(1) for motion in motions]
    everything = torch.cat(inputs)
    order = torch.randperm(len(everything), generator=generator)
    inducing, some = everything[order[: settings.inducing]], order[: settings.subset]
    kernels: list[Kernel] = []
    chosen: list[CrossValidated] = []
    for number, group in enumerate(regions):
        say(f"process {number + 1} of {len(regions)}")
        looked_at = torch.zeros_like(feature_scale)
        looked_at[:, list(group)] = 1.0
        kernels.append(
            fitted_kernel(everything[some], steps[some][:, list(group)], inducing, looked_at, settings.rounds)
        )
        targets = [part[:, list(group)] for part in unseen]
        chosen.append(cross_validated(kernels[-1], inducing, inputs, targets, max(settings.memory * fps, 1.0)))
    say("noise")
    told, known = torch.zeros_like(steps), torch.zeros_like(steps)
    weights = [torch.zeros(len(inducing), len(names), dtype=torch.float64) for _ in regions]
    for group, one, row in zip(regions, chosen, weights, strict=True):
        told[:, list(group)], known[:, list(group)] = one.mean, one.variance[:, None]
        row[:, list(group)] = one.posterior.weights
    moving = torch.cat([moving_parts(part.windows, motion) for part, motion in zip(parts, motions, strict=True)])
    noise = MotionNoise.fit(
        moving,
        (torch.cat(unseen) - told) * target_scale,
        known * target_scale.square(),
        moving.square().mean(0).sqrt().clamp(min=_SMALLEST),
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
            trust=torch.tensor([one.trust for one in chosen], dtype=torch.float64),
            limits=torch.stack([frames.min().clamp(max=0.0), frames.max().clamp(min=1.0)]),
            fps=fps,
            input_noise=input_noise,
        )
        .float()
        .eval()
    )


def fitted_kernel(inputs: Tensor, targets: Tensor, inducing: Tensor, looked_at: Tensor, rounds: int) -> Kernel:
    """Hyperparameters that maximise the bound of the marginal likelihood with inducing points, all targets together.

    One length for places, one for slopes, one for curvatures; by Adam on what gpytorch makes of them so that they stay
    positive.

    Args:
        inputs: (B,O·N), scaled.
        targets: (B,n), scaled.
        inducing: (M,O·N).
        looked_at: 1 for inputs that the kernel looks at, else 0, (O,N).
        rounds: of Adam.

    Source: Titsias 2009.
    """
    gpytorch = import_gpytorch()
    from linear_operator.utils.warnings import NumericalWarning

    columns = [looked_at[order].nonzero()[:, 0] + order * looked_at.shape[1] for order in range(len(looked_at))]
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
    optimizer = torch.optim.Adam(points.parameters(), lr=_STEP)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)  # of the jitter that inducing points close by need
        for _ in range(rounds):  # each step needs the one before
            optimizer.zero_grad()
            covariance = points(inputs[:, used]).evaluate_kernel().add_diagonal(likelihood.noise.expand(len(inputs)))
            fit, volume = covariance.inv_quad_logdet(targets, logdet=True)
            missed = sum(term.loss() for term in points.added_loss_terms())
            loss = (0.5 * (fit + targets.shape[1] * volume) - targets.shape[1] * missed) / targets.numel()
            loss.backward()
            optimizer.step()
    lengths = [one.lengthscale.item() for one in scaled.base_kernel.modules() if hasattr(one, "raw_lengthscale")]
    inverse = looked_at / torch.tensor(lengths, dtype=looked_at.dtype)[:, None]
    return Kernel(scaled.outputscale.item(), inverse.flatten(), likelihood.noise.item())


@dataclass(frozen=True, eq=False)
class CrossValidated:
    """A process learned from all parts, and what it tells of each part when learned from the others.

    Args:
        posterior: of all parts.
        trust: by what its mean is multiplied, in [0,1].
        mean: of the parts left out, trust included, (B,n).
        variance: of the same, without noise, (B,).
    """

    posterior: Posterior
    trust: float
    mean: Tensor
    variance: Tensor


def cross_validated(
    kernel: Kernel, inducing: Tensor, inputs: Sequence[Tensor], targets: Sequence[Tensor], redundancy: float
) -> CrossValidated:
    """Learns a process, and how far to trust it by what it tells of parts left out in turn.

    Args:
        kernel: of the process.
        inducing: (M,F).
        inputs: of each part, (B,F).
        targets: of each part, as they look to one that has not seen the part, (B,n).
        redundancy: how many frames tell as much as a single independent one.
    """
    whitening = whitening_of(kernel, inducing)
    near = [kernel.between(part, inducing) for part in inputs]
    features = [part @ whitening for part in near]
    evidence = [Evidence(f.T @ f, f.T @ t) for f, t in zip(features, targets, strict=True)]
    means, variances = [], []
    for i, (k, f) in enumerate(zip(near, features, strict=True)):
        own = posterior(kernel, inducing, whitening, _summed(evidence[:i] + evidence[i + 1 :]), redundancy)
        told = k @ own.spread
        means.append(told @ own.weights)
        variances.append((kernel.signal - f.square().sum(1)).clamp(min=0.0) + told.square().sum(1))
    mean, wanted = torch.cat(means), torch.cat(list(targets))
    # A lively take must not decide for all: errors count relative to those that the take has without the process.
    weight = torch.cat([(1 / t.square().sum().clamp(min=_SMALLEST)).expand(len(t), 1) for t in targets])
    trust = float(((weight * mean * wanted).sum() / (weight * mean.square()).sum().clamp(min=1e-12)).clamp(0, 1))
    whole = posterior(kernel, inducing, whitening, _summed(evidence), redundancy)
    return CrossValidated(whole, trust, trust * mean, trust**2 * torch.cat(variances))


def _own_coefficients(parts: Sequence[_Part]) -> tuple[Tensor, list[Tensor]]:
    """Each shape's step from its own frames, (J,N): by least squares from all parts, and from all but each.

    A window that rests is to go on resting wherever it does, so the step is a sum of the steps before: a shape that
    the takes never raised must not be drawn back to where they left it. What is common to all shapes is learned from
    all, and each differs from it as far as its own frames tell.
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
    usual = square.mean(0) + ridge
    common = torch.linalg.solve(usual, product.mean(0))
    own = torch.linalg.solve(square + _COMMON * usual, product + _COMMON * (usual @ common))
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


def _summed(evidence: Sequence[Evidence]) -> Evidence:
    total = evidence[0]
    for one in evidence[1:]:
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
