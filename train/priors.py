"""``torchface train priors --takes DIR --out models/NAME``: which weights faces have, and how they go on.

From weight takes (Live Link Face, CSV), or from marker takes (C3D, TRC, CSV) with ``--rig`` and ``--attachment``: they
are laid on the rig and solved first. ``--performances 12`` learns from synthetic takes of the embedded performer
instead, and needs no file. ``--names`` and ``--rig`` make a prior for a rig's own names out of takes with ARKit's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from torch import Tensor

from torchface import Attachment, BlendshapeRig, load_rig, zoo
from torchface.capture.priors import (
    DynamicsPrior,
    DynamicsSettings,
    GaussianMixture,
    ParzenDensity,
    ReciprocalPrior,
    ShapePrior,
    automatic_bandwidth,
    face_halves,
)
from torchface.capture.priors.seen_frames import MOST_FRAMES, SeenFrames
from torchface.errors import ValueRangeError
from torchface.progress import Progress
from torchface.synthetic import performer

from .model_cards import model_card
from .prior_figures import calibration_picture, choice_picture, curves_picture, save_figure
from .prior_takes import PriorTakes, read_takes, renamed, split, synthetic_takes
from .prior_trials import one_step, solve_error, synthetic_video, with_strength
from .recipe_settings import RecipeSettings
from .runner import Recipe, Run, metric_lines, recipe

Kind = Literal["shape", "reciprocal", "dynamics", "both"]
_WINDOWS = (2, 3, 4, 6, 8)
_STRENGTHS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
_BANDWIDTHS = (0.5, 1.0, 2.0)  # times the automatic one
_TRIED = 20  # takes: of more that are held out, so many are solved and predicted for the card


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        takes: Folder of takes.
        performances: Learn from so many synthetic takes of the embedded performer instead.
        frames: Of each synthetic take.
        kind: shape (Student's t-distribution), reciprocal (the paper's 1/P over a Parzen window),
            dynamics, or both (shape and dynamics).
        rig: The rig that the priors are for: its names, and marker takes are solved with it.
        attachment: Where the markers of marker takes sit, as JSON.
        part: Keep this region of the rig only, such as face.
        names: The names that the priors are for; those of the rig if there is one, else those of the takes.
        fps: Frames a second that the takes are brought to; as the first take has if absent.
        held_out: How many takes, the last by name, are kept for the test; a third if absent.
        window: Frames that the next one is predicted from; chosen if absent.
        input_noise: Standard deviation of the weights in a window, for windows of solved weights.
        strength: Of the shape prior; chosen by trial solves if absent.
        bandwidth: Of the Parzen window (reciprocal); the automatic one, or what trials say is better, if absent.
        pixel_noise: Of the landmarks in the trial solves, pixels.
        trial_frames: How many frames of each take are solved in a trial.
        inducing: How many windows stand for all others.
        iterations: Of the ascent on the marginal likelihood.
        pictures: Folder for the pictures; OUT/pictures if absent.
    """

    takes: Path | None = None
    performances: int = 0
    frames: int = 1800
    out: Path = Path("models/prior")
    kind: Kind = "both"
    rig: Path | None = None
    attachment: Path | None = None
    part: str | None = None
    names: tuple[str, ...] = ()
    fps: float | None = None
    held_out: int | None = None
    window: int | None = None
    input_noise: float = 0.01
    strength: float | None = None
    bandwidth: float | None = None
    pixel_noise: float = 1.0
    trial_frames: int = 60
    inducing: int = 100
    iterations: int = 50
    pictures: Path | None = None


@dataclass(frozen=True, eq=False)
class Material:
    """What both kinds learn from.

    Args:
        learn: takes to learn from.
        test: takes that are looked at once, for the card.
        rig: on which trial solves are made.
        silent: shapes that the takes say nothing of.
    """

    learn: PriorTakes
    test: PriorTakes
    rig: BlendshapeRig
    silent: tuple[str, ...]


@recipe
def train(settings: Settings, run: Run) -> dict[str, dict[str, float]]:
    """Loads, names, splits, chooses, fits, evaluates, saves, draws.

    Returns:
        What was measured, by the folder's name.

    Raises:
        TorchfaceError: neither takes nor performances; too few takes, too short ones, ones with NaN or with different
            shapes; marker takes without rig and attachment.
    """
    progress = run.progress
    _check_one_source(settings)
    material = _material(settings, run.work, progress)
    both = settings.kind == "both"
    measured = {}
    if settings.kind != "dynamics":
        out = settings.out.with_name(f"{settings.out.name}_shape") if both else settings.out
        measured[out.name] = _shape(settings, out, material, progress)
    if settings.kind in ("dynamics", "both"):
        out = settings.out.with_name(f"{settings.out.name}_dynamics") if both else settings.out
        measured[out.name] = _dynamics(settings, out, material, progress)
    return measured


def _shape(settings: Settings, out: Path, material: Material, progress: Progress) -> dict[str, float]:
    """A shape prior; its strength is chosen with the last of the takes to learn from, left out for that."""
    learn, test, names = material.learn, material.test, material.learn.names
    fitting, choosing = _for_choice(learn)
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
        single = ShapePrior(names, prior.groups, [_gaussian(learn, group) for group in prior.groups])
        metrics["held out, log density of one Gaussian"] = _mean_log_density(single, test)
    tried = test.spread(_TRIED)
    tested = synthetic_video(material.rig, names, tried.weights, noise, count, settings.seed + 1)
    if tested is not None:
        metrics |= {
            "held out, error of a weight without a prior": solve_error(tested, None, noise),
            "held out, error of a weight": solve_error(tested, prior, noise),
        }
    prior = prior.float()
    limits = _limits(settings, material, "The Parzen window" if settings.kind == "reciprocal" else "")
    card = (
        "The density of a face's weights: "
        + (
            "Student's t-distribution about the face at rest, with the correlation of shapes"
            if settings.kind != "reciprocal"
            else "the paper's 1/P over a Parzen window for each half of the face"
        )
        + ". Holds a solve from few points, such as 68 landmarks of one camera, to faces like those it has learned "
        f"from. {limits} The strength was chosen by solves of a take that was left out, from 68 "
        f"landmarks of one camera with {settings.pixel_noise:g} pixel of noise, the head's pose unknown; 1 is Bayes' "
        "rule. The test takes took no part in that."
    )
    _save(prior, out, settings, material, metrics, card)
    folder = settings.pictures or out / "pictures"
    if points and settings.strength is None:
        figure = choice_picture({"root mean square error of a weight, take left out": points}, "strength")
        save_figure(figure, folder / "strength.png")
    return metrics


def _dynamics(settings: Settings, out: Path, material: Material, progress: Progress) -> dict[str, float]:
    """A dynamics prior; its window is chosen with the last of the takes to learn from, left out for that."""
    learn, test = material.learn, material.test
    how = DynamicsSettings(inducing=settings.inducing, iterations=settings.iterations, seed=settings.seed)

    def fitted(takes: PriorTakes, window: int) -> DynamicsPrior:
        return DynamicsPrior.fit(
            takes.weights, takes.names, window, fps=takes.fps, input_noise=settings.input_noise, settings=how
        )

    window = settings.window
    tried: dict[str, list[tuple[float, float]]] = {"negative log likelihood a weight": [], "one-step error": []}
    if window is None:
        fitting, choosing = _for_choice(learn)
        shortest = min(*fitting.frames, *choosing.frames)
        for candidate in _WINDOWS:
            if shortest <= candidate + 8:
                continue
            progress(f"trying a window of {candidate} frames")
            found = one_step(fitted(fitting, candidate), choosing.weights, settings.input_noise).metrics()
            for key, values in tried.items():
                values.append((candidate, found[key]))
        scores = tried["one-step error"]
        if not scores:
            raise ValueRangeError(
                f"takes: the shortest has {shortest} frames, expected more than {_WINDOWS[0] + 8}, or a window"
            )
        window = int(min(scores, key=lambda point: point[1])[0])
    progress(f"fitting the dynamics prior with a window of {window} frames")
    prior = fitted(learn, window)
    trial = one_step(prior, test.spread(_TRIED).weights, settings.input_noise)
    metrics = {"window": float(window)} | {f"held out, {key}": value for key, value in trial.metrics().items()}
    card = (
        f"Mean and variance of the next frame's weights from the last {window} frames at "
        f"{learn.fps:g} frames a second: Gaussian processes, one for each region of the face, and a noise that grows "
        "with the motion. Holds a solve to how faces move and bridges frames without landmarks. "
        f"{_limits(settings, material, 'The noise')} Windows carried noise of {settings.input_noise:g} a weight, in "
        "learning and in the test, as solved weights do. Errors are root mean squares in weights; the log likelihood "
        "leaves out its constant. The window was chosen on a take that was left out; the test takes took no part in "
        "that. A video of another frame rate needs a prior of that rate (--fps)."
    )
    _save(prior, out, settings, material, metrics, card)
    folder = settings.pictures or out / "pictures"
    save_figure(calibration_picture(trial), folder / "calibration.png")
    save_figure(curves_picture(prior, test.weights[0]), folder / "curves.png")
    if settings.window is None:
        tables = {key: {"take left out": values} for key, values in tried.items()}
        save_figure(choice_picture(tables, "window, frames"), folder / "window.png")
    return metrics


def _check_one_source(settings: Settings) -> None:
    if (settings.takes is None) == (settings.performances <= 0):
        raise ValueRangeError(
            f"found takes={settings.takes} and performances={settings.performances}; expected a folder of takes, or a "
            "number of performances"
        )


def _material(settings: Settings, work: Path, progress: Progress) -> Material:
    """The takes, on disk, under the names that the priors are for; what cannot work is refused before learning."""
    rig = None if settings.rig is None else load_rig(settings.rig, part=settings.part)
    if settings.takes is None:
        takes = synthetic_takes(settings.performances, settings.frames, settings.seed, work, settings.fps, progress)
    else:
        attachment = None if settings.attachment is None else Attachment.load(settings.attachment)
        takes = read_takes(settings.takes, work, settings.fps, rig, attachment, progress)
    names: Sequence[str] = settings.names or (takes.names if rig is None else rig.names)
    if rig is None:
        rig = performer(texture=False)
        if settings.takes is None and not settings.names:
            names = rig.names
    takes, silent = renamed(takes, names)
    if silent:
        progress(f"the takes say nothing of {', '.join(silent)}; these stay at 0")
    learn, test = split(takes, settings.held_out)
    progress(f"{sum(learn.frames)} frames of {len(learn.weights)} takes to learn from, "
        f"{sum(test.frames)} of {len(test.weights)} to test on")  # fmt: skip
    return Material(learn, test, rig, silent)


def _for_choice(learn: PriorTakes) -> tuple[PriorTakes, PriorTakes]:
    """The takes to learn from without the last one, and the last one; of a single take its first and last parts."""
    if len(learn.weights) > 1:
        return split(learn, 1)
    first, last = learn.weights[0].tensor_split([3 * len(learn.weights[0]) // 4])
    return replace(learn, weights=[first], frames=[len(first)]), replace(learn, weights=[last], frames=[len(last)])


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
    return SeenFrames(takes.weights, len(takes.names)).some(seed=seed)


def _gaussian(takes: PriorTakes, group: Sequence[int]) -> GaussianMixture:
    return GaussianMixture.single(SeenFrames(takes.weights, len(takes.names), tuple(group))).double()


def _mean_log_density(prior: ShapePrior, takes: PriorTakes) -> float:
    total = sum(float(prior.log_density(take).sum()) for take in takes.weights)
    return total / sum(takes.frames)


def _densities(prior: ShapePrior) -> dict[str, float]:
    """How many bells a Parzen window has in each half, and how wide they are."""
    found = {}
    for number, density in enumerate(prior.densities):
        half = ("upper", "lower")[number] if len(prior.groups) == 2 else f"group {number}"
        if isinstance(density, ParzenDensity):
            found[f"centers, {half}"] = float(len(density.centers))
            found[f"bandwidth, {half}"] = float(density.bandwidth)
    return found


def _limits(settings: Settings, material: Material, at_once: str = "") -> str:
    """What the card says about whom the takes show, and what was learned from some of the frames alone."""
    silent = f" The takes say nothing of {', '.join(material.silent)}: these stay at 0." if material.silent else ""
    if at_once and sum(material.learn.frames) > MOST_FRAMES:
        silent += f" {at_once} was learned from {MOST_FRAMES:,} frames drawn from all, which it needs at once."
    if len(material.test.weights) > _TRIED:
        silent += f" Solves and predictions are of {_TRIED} of the test takes, evenly spread."
    if settings.takes is None:
        return (
            "It has learned from synthetic takes only: twelve gestures with smooth ramps, blinks, glances and "
            "syllables of an actor made by code. Good for trying the tools, for tests and for footage of that "
            "performer; real faces combine and time their shapes in ways it has never seen, so "
            f"learn another prior from real takes for them.{silent}"
        )
    return f"Good for faces that move as those of these takes do, with a rig of these names.{silent}"


def _save(
    prior: ShapePrior | DynamicsPrior,
    out: Path,
    settings: Settings,
    material: Material,
    metrics: dict[str, float],
    card: str,
) -> None:
    """Writes the model with its effective settings, measured errors and card."""
    kind = settings.kind if settings.kind != "both" else "dynamics" if isinstance(prior, DynamicsPrior) else "shape"
    learn, test = material.learn, material.test
    frames = sum(learn.frames)
    if settings.takes is None:
        source = f"{len(learn.weights)} synthetic takes of the embedded performer, {frames} frames; no person's."
    else:
        solved = ", solved from markers" if learn.solved else ""
        source = f"{len(learn.weights)} takes of {settings.takes.name}, {frames} frames{solved}."
    known = model_card(
        replace(settings, kind=kind, out=out),
        licence="MIT" if settings.takes is None else "that of the takes",
        data=f"{source} {len(learn.names)} shapes; tested on {len(test.weights)} more takes.",
        metrics=metrics,
        text=card,
    )
    zoo.save_model(prior, out, known)


def _lines(_: Settings, measured: dict[str, dict[str, float]]) -> list[str]:
    return [line for name, metrics in measured.items() for line in (name, *metric_lines(metrics, "8.4f"))]


RECIPE = Recipe(Settings, train, __doc__, _lines)

if __name__ == "__main__":
    RECIPE.main()
