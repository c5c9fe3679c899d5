"""``torchface train priors --takes DIR --out models/NAME``: which weights faces have, and how they go on.

From weight takes (Live Link Face, CSV), or from marker takes (C3D, TRC, CSV) with ``--rig`` and ``--attachment``: they
are aligned with the rig and solved first. ``--performances 60`` learns from takes of so many people made by code
instead, and needs no file. ``--names`` and ``--rig`` make a prior for a rig's own names out of takes with ARKit's.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from torchface import Attachment, load_rig, zoo
from torchface.errors import ValueRangeError
from torchface.progress import Progress
from torchface.synthetic import performer

from .dynamics_priors import learned_dynamics
from .model_cards import model_card
from .prior_figures import save_figure
from .prior_settings import LearnedPrior, Material, PriorSettings
from .prior_takes import read_takes, renamed, split, synthetic_takes
from .runner import Recipe, Run, metric_lines, recipe
from .shape_priors import learned_shape


class Settings(PriorSettings):
    """What the recipe does."""


@recipe
def train(settings: Settings, run: Run) -> dict[str, dict[str, float]]:
    """Loads, names, splits, chooses, fits, evaluates, saves, draws; what was measured, by the folder's name."""
    _check_one_source(settings)
    material = _material(settings, run.work, run.progress)
    measured = {}
    for kind, out in zip(settings.kinds, settings.folders, strict=True):
        own = replace(settings, kind=kind, out=out)
        learned = learned_dynamics if kind == "dynamics" else learned_shape
        prior = learned(own, material, run.progress)
        _save(prior, own, material)
        measured[out.name] = prior.metrics
    return measured


def _check_one_source(settings: Settings) -> None:
    if (settings.takes is None) == (settings.performances <= 0):
        raise ValueRangeError(
            f"found --takes {settings.takes} and --performances {settings.performances}; expected a folder of "
            "takes, or a number of performances"
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


def _save(found: LearnedPrior, settings: Settings, material: Material) -> None:
    """Writes the model with its effective settings, measured errors, card and pictures."""
    learn, test = material.learn, material.test
    frames = sum(learn.frames)
    if settings.takes is None:
        source = f"{len(learn.weights)} takes of people made by code, {frames} frames; no real person's."
    else:
        solved = ", solved from markers" if learn.solved else ""
        source = f"{len(learn.weights)} takes of {settings.takes.name}, {frames} frames{solved}."
    card = model_card(
        settings,
        licence="MIT" if settings.takes is None else "that of the takes",
        data=f"{source} {len(learn.names)} shapes; tested on {len(test.weights)} more takes.",
        metrics=found.metrics,
        text=found.text,
    )
    zoo.save_model(found.prior, settings.out, card)
    for name, picture in found.pictures.items():
        save_figure(picture, (settings.pictures or settings.out / "pictures") / f"{name}.png")


def _lines(_: Settings, measured: dict[str, dict[str, float]]) -> list[str]:
    return [line for name, metrics in measured.items() for line in (name, *metric_lines(metrics, "8.4f"))]


RECIPE = Recipe(Settings, train, __doc__, _lines)

if __name__ == "__main__":
    RECIPE.main()
