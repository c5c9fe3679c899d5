"""Settings of the recipe of priors, and what both kinds of priors learn from."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from matplotlib.figure import Figure

from torchface import BlendshapeRig
from torchface.capture.priors import DynamicsPrior, ShapePrior
from torchface.capture.priors.take_frames import MOST_FRAMES

from .prior_takes import PriorTakes, split
from .recipe_settings import RecipeSettings

Kind = Literal["shape", "reciprocal", "dynamics", "both"]
TRIED = 20
"""Takes: of more that are held out, so many are solved and predicted for the card."""


@dataclass(frozen=True, kw_only=True)
class PriorSettings(RecipeSettings):
    """What the recipe does.

    Args:
        takes: Folder of takes, or of a folder of takes for each person.
        performances: Learn from takes of so many people made by code instead.
        frames: Of each such take.
        kind: shape (Student's t-distribution), reciprocal (the paper's 1/P over a Parzen window),
            dynamics, or both (shape and dynamics).
        rig: The rig that the priors are for: its names, and marker takes are solved with it.
        attachment: Where the markers of marker takes sit, as JSON.
        part: Keep this region of the rig only, such as face.
        names: The names that the priors are for; those of the rig if there is one, else those of the takes.
        fps: Frames a second that the takes are brought to; as the first take has if absent.
        held_out: How many takes, the last by name, are kept for the test, with all others of the same people, where
            each has a folder of takes; a third if absent.
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

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Of the priors that the run makes."""
        return ("shape", "dynamics") if self.kind == "both" else (self.kind,)

    @property
    def folders(self) -> tuple[Path, ...]:
        if self.kind != "both":
            return (self.out,)
        return tuple(self.out.with_name(f"{self.out.name}_{kind}") for kind in self.kinds)


@dataclass(frozen=True, eq=False)
class Material:
    """What both kinds learn from."""

    learn: PriorTakes
    test: PriorTakes  # takes that are looked at once, for the card
    rig: BlendshapeRig  # on which trial solves are made
    silent: tuple[str, ...]  # shapes that the takes say nothing of


@dataclass(frozen=True, eq=False)
class LearnedPrior:
    """A prior, what was measured, what its card says, and its pictures by name."""

    prior: ShapePrior | DynamicsPrior
    metrics: dict[str, float]
    text: str
    pictures: dict[str, Figure]


def for_choice(learn: PriorTakes) -> tuple[PriorTakes, PriorTakes]:
    """The takes to learn from without the last one, and the last one; of a single take its first and last parts."""
    if len(set(learn.people)) > 1:
        return split(learn, 1)
    if len(learn.weights) > 1:
        rows = range(len(learn.weights))
        return learn.some(rows[:-1]), learn.some(rows[-1:])
    first, last = learn.weights[0].tensor_split([3 * len(learn.weights[0]) // 4])
    return replace(learn, weights=[first], frames=[len(first)]), replace(learn, weights=[last], frames=[len(last)])


def limits(settings: PriorSettings, material: Material, at_once: str = "") -> str:
    """What the card says about whom the takes show, and what was learned from some of the frames alone."""
    silent = f" The takes say nothing of {', '.join(material.silent)}: these stay at 0." if material.silent else ""
    if at_once and sum(material.learn.frames) > MOST_FRAMES:
        silent += f" {at_once} was learned from {MOST_FRAMES:,} frames drawn from all, which it needs at once."
    if len(material.test.weights) > TRIED:
        silent += f" Solves and predictions are of {TRIED} of the test takes, evenly spread."
    if settings.takes is None:
        return (
            "It has learned from takes made by code: action units go together as coded films of people have them, with "
            "speech, blinks and glances. No real person's weights are in it; one's own takes make a better prior of "
            f"one's own actor.{silent}"
        )
    return f"Good for faces that move as those of these takes do, with a rig of these names.{silent}"
