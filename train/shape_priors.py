"""Shape priors learned from takes; strength and width are chosen by trial solves."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.capture import ShapePrior
from torchface.capture.priors import ParzenDensity, ReciprocalPrior, automatic_bandwidth, face_halves
from torchface.capture.priors.take_frames import TakeFrames
from torchface.progress import Progress

from .prior_figures import choice_picture
from .prior_settings import TRIED, Kind, LearnedPrior, Material, PriorSettings, for_choice, limits
from .prior_takes import PriorTakes
from .prior_trials import solve_error, synthetic_video, with_strength

_STRENGTHS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
_BANDWIDTHS = (0.5, 1.0, 2.0)  # times the automatic one


def learned_shape(settings: PriorSettings, material: Material, progress: Progress) -> LearnedPrior:
    """A shape prior; its strength is chosen with the last of the takes to learn from, left out for that."""
    learn, test, names = material.learn, material.test, material.learn.names
    fitting, choosing = for_choice(learn)
    noise, count = settings.pixel_noise, settings.trial_frames
    trial = synthetic_video(material.rig, names, choosing.weights, noise, 2 * count, settings.seed)
    points: dict[str, list[tuple[float, float]]] = {}
    strength = 1.0 if settings.strength is None else settings.strength
    width = settings.bandwidth
    if settings.kind == "reciprocal":
        automatic = _automatic(learn, settings.seed)
        widths = {1.0: automatic} if width is None else {width: [width] * len(automatic)}
        if width is None and trial is not None:
            widths = {factor: [factor * one for one in automatic] for factor in _BANDWIDTHS}
    else:
        widths = {1.0: []}
    least, chosen = float("inf"), next(iter(widths))
    if trial is not None and (settings.strength is None or len(widths) > 1):
        progress("choosing the strength by trial solves")
        without = solve_error(trial, None, noise)
        points["none"] = [(_STRENGTHS[0], without), (_STRENGTHS[-1], without)]
        for factor, own in widths.items():
            prior = _fitted(settings.kind, fitting, own, settings.seed)
            strengths = _STRENGTHS if settings.strength is None else (settings.strength,)
            label = f"{factor:g} times the automatic bandwidth" if own else "this prior"
            points[label] = [(s, solve_error(trial, with_strength(prior, s), noise)) for s in strengths]
            best = min(points[label], key=lambda point: point[1])
            if best[1] < least:
                least, chosen, strength = best[1], factor, best[0]
    progress("fitting the shape prior")
    prior = with_strength(_fitted(settings.kind, learn, widths[chosen], settings.seed), strength)
    metrics = {"strength": strength, **_densities(prior)}
    if settings.kind != "reciprocal":
        metrics["held out, log density a frame"] = _mean_log_density(prior.double(), test)
        metrics["held out, log density of one Gaussian"] = sum(_gaussian(learn, test, g) for g in prior.groups)
    tried = test.spread(TRIED)
    tested = synthetic_video(material.rig, names, tried.weights, noise, count, settings.seed + 1)
    if tested is not None:
        metrics |= {
            "held out, error of a weight without a prior": solve_error(tested, None, noise),
            "held out, error of a weight": solve_error(tested, prior, noise),
        }
    prior = prior.float()
    known = limits(settings, material, "The Parzen window" if settings.kind == "reciprocal" else "")
    card = (
        "The density of a face's weights: "
        + (
            "Student's t-distribution about the face at rest, with the correlation of shapes"
            if settings.kind != "reciprocal"
            else "the paper's 1/P over a Parzen window for each half of the face"
        )
        + ". Holds a solve from few points, such as 68 landmarks of one camera, to faces like those it has learned "
        f"from. {known} The strength was chosen by solves of a take that was left out, from 68 "
        f"landmarks of one camera with {settings.pixel_noise:g} pixel of noise, the head's pose unknown; 1 is Bayes' "
        "rule. The test takes took no part in that."
    )
    pictures = {}
    if points and settings.strength is None:
        errors = {"root mean square error of a weight, take left out": points}
        pictures["strength"] = choice_picture(errors, "strength")
    return LearnedPrior(prior, metrics, card, pictures)


def _fitted(kind: Kind, takes: PriorTakes, widths: Sequence[float], seed: int) -> ShapePrior:
    if kind != "reciprocal":
        return ShapePrior.fit(takes.weights, takes.names)
    together = _some(takes, seed)
    groups = face_halves(takes.names)
    densities = [
        ParzenDensity.fit(together[:, list(group)], width, seed) for group, width in zip(groups, widths, strict=True)
    ]
    return ReciprocalPrior(takes.names, groups, densities)


def _automatic(takes: PriorTakes, seed: int) -> list[float]:
    together = _some(takes, seed)
    return [automatic_bandwidth(together[:, list(group)], seed=seed) for group in face_halves(takes.names)]


def _some(takes: PriorTakes, seed: int) -> Tensor:
    """The frames that a Parzen window is made of, (F,N): all, or of very many some that are drawn."""
    return TakeFrames(takes.weights, len(takes.names)).some(seed=seed)


def _gaussian(learn: PriorTakes, test: PriorTakes, group: Sequence[int]) -> float:
    """The mean log density of test frames' weights of a group by one Gaussian."""
    x, rows = TakeFrames(learn.weights, len(learn.names), tuple(group)).some(), list(group)
    covariance = torch.cov(x.T).reshape(len(rows), -1) + 1e-4 * torch.eye(len(rows)).double()
    normal = torch.distributions.MultivariateNormal(x.mean(0), covariance)
    return sum(float(normal.log_prob(take[:, rows].double()).sum()) for take in test.weights) / sum(test.frames)


def _mean_log_density(prior: ShapePrior, takes: PriorTakes) -> float:
    total = sum(float(prior.log_density(take).sum()) for take in takes.weights)
    return total / sum(takes.frames)


def _densities(prior: ShapePrior) -> dict[str, float]:
    """How many bells a Parzen window has in each half, and how wide they are."""
    densities = {}
    for number, density in enumerate(prior.densities):
        half = ("upper", "lower")[number] if len(prior.groups) == 2 else f"group {number}"
        if isinstance(density, ParzenDensity):
            densities[f"centers, {half}"] = float(len(density.centers))
            densities[f"bandwidth, {half}"] = float(density.bandwidth)
    return densities
