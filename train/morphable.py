"""``python -m train.morphable --scans DIR --out models/NAME``: a head model, shape and colour, of registered meshes.

``--performers 200`` learns from so many embedded performers instead, and needs no file. Killed and started again, a
run goes on where it was.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro

from torchface import TorchfaceError, load_mesh, zoo
from torchface.errors import ValueRangeError
from torchface.geometry.samples import SampleRange, Samples, blocks
from torchface.modeling import HeadModel
from torchface.modeling.model_quality import ModelQuality, model_quality
from torchface.modeling.sequence_fit import fit_sequence
from torchface.rendering.compositing import save_picture
from torchface.viz.model_pictures import (
    color_modes_picture,
    far_picture,
    modes_picture,
    morph_picture,
    quality_picture,
    random_picture,
    scatter_picture,
)
from train.head_samples import Source, balanced_colors, gather, laid, performers, registered

_TESTED_PERFORMERS = 20
_MEASURED = 500  # heads; leaving one out takes an eigensystem of so many for each
_HALF = ("shape.components", "color.components")


@dataclass(frozen=True)
class Settings:
    """What the recipe does.

    Args:
        scans: Folder of registered meshes, all of one topology, in any place; what `torchface register` writes.
        performers: Learn from so many embedded performers instead of a folder's meshes.
        out: Folder for the model, its card and its pictures.
        template: A mesh of the same topology that says where and how upright the heads are to stand, and brings
            annotations; the first mesh where absent, set upright by its landmarks if it has any.
        held_out: How many meshes, the last by name, are kept for the test; or how many more performers are drawn for
            it. A tenth if absent, and 20 performers.
        components: How many components of shape; all if absent, at most 200.
        color_components: How many components of colour; likewise.
        variance: Keep as few components of shape as hold this share of the variance.
        scale: Take the heads' sizes off as well as their places.
        white_balance: Free the colours from each scan's exposure and white balance; performers have none.
        half: Store components in half precision.
        seed: Draws performers, and random heads for pictures and specificity.
        licence: Under which the model may be used; MIT for performers, else what the scans allow, if absent.
        pictures: Folder for the pictures; OUT/pictures if absent.
    """

    scans: Path | None = None
    performers: int = 0
    out: Path = Path("models/head")
    template: Path | None = None
    held_out: int | None = None
    components: int | None = None
    color_components: int | None = None
    variance: float | None = None
    scale: bool = False
    white_balance: bool = True
    half: bool = False
    seed: int = 7
    licence: str | None = None
    pictures: Path | None = None


@dataclass(frozen=True, eq=False)
class Trained:
    """The model, what was measured, and the curves."""

    model: HeadModel
    metrics: dict[str, float]
    quality: ModelQuality | None


def train(settings: Settings, say: Callable[[str], None] | None = None) -> Trained:
    """Loads, aligns, splits, fits, evaluates, saves, draws.

    Raises:
        TopologyError: a mesh has another topology than the first.
        TorchfaceError: neither scans nor performers, too few of them, all the same, or more components than they hold.
    """
    say = say or (lambda line: None)
    source, held_out = _source(settings)
    template = None if settings.template is None else load_mesh(settings.template)
    work = settings.out.parent / f".{settings.out.name}.training"
    work.mkdir(parents=True, exist_ok=True)
    gathered = gather(source, held_out, work, template, say)
    count = len(gathered.shapes) - gathered.held_out
    say(f"{count} heads to learn from, {gathered.held_out} to test on")
    say("laying the heads on each other")
    learn, test = laid(gathered, settings.scale)
    say("fitting the shape")
    shape = fit_sequence(learn, settings.components, work / "shape", _counting(say, "shape"))
    if settings.variance is not None:
        shape = shape.truncate(variance=settings.variance)
    color, test_colors = None, None
    if gathered.colors is not None:
        say("fitting the colours")
        balanced = balanced_colors(
            gathered.colors, gathered.template, settings.white_balance and not settings.performers, say
        )
        learned = SampleRange(balanced, 0, count)
        test_colors = SampleRange(balanced, count, len(gathered.shapes))
        try:
            color = fit_sequence(learned, settings.color_components, work / "color", _counting(say, "colours"))
        except ValueRangeError as error:
            say(f"no model of colours: {error}")
            test_colors = None
    model = HeadModel.on(gathered.template, shape, color)
    say("measuring")
    quality = None
    if count >= 3:
        some = min(count, _MEASURED)
        generator = torch.Generator().manual_seed(settings.seed)
        numbers = _spread(range(1, min(some - 2, shape.count) + 1))
        quality = model_quality(SampleRange(learn, 0, some), numbers, generator=generator)
    metrics = measured(model, quality, test, test_colors)
    save(model, settings, metrics, count, gathered.held_out)
    draw(model, settings, quality, learn, test, say)
    shutil.rmtree(work, ignore_errors=True)
    return Trained(model, metrics, quality)


def measured(
    model: HeadModel, quality: ModelQuality | None, test: Samples, test_colors: Samples | None
) -> dict[str, float]:
    """What goes into the card: millimetres and shares."""
    metrics = {"shape components": float(model.shape.count), "shape variance held": float(model.shape.explained[-1])}
    if test.shape[0]:
        far = [
            (model.shape(model.shape.project(part)) - part).norm(dim=-1)
            for part in (test.read(*block) for block in blocks(test))
        ]
        mean = [(part - model.shape.mean).norm(dim=-1) for part in (test.read(*block) for block in blocks(test))]
        metrics["held out, mean error mm"] = float(torch.cat(far).mean())
        metrics["held out, of the mean head's error"] = float(torch.cat(far).mean() / torch.cat(mean).mean())
    if quality is not None:
        metrics["generalisation mm"] = float(quality.generalisation[-1])
        metrics["specificity mm"] = float(quality.specificity[-1])
        metrics["nearest samples mm"] = quality.nearest
    if model.color is not None:
        metrics["color components"] = float(model.color.count)
        metrics["color variance held"] = float(model.color.explained[-1])
        if test_colors is not None and test_colors.shape[0]:
            parts = [test_colors.read(*block) for block in blocks(test_colors)]
            errors = [(model.color(model.color.project(part)) - part).abs() for part in parts]
            metrics["held out, mean color error"] = float(torch.cat(errors).mean())
    return metrics


def save(model: HeadModel, settings: Settings, metrics: dict[str, float], count: int, held_out: int) -> None:
    """Writes the model with its effective settings, measured errors and card."""
    effective = {key: value for key, value in asdict(settings).items() if value is not None}
    effective |= {key: value.name for key, value in effective.items() if isinstance(value, Path)}
    if settings.performers:
        data = f"{count} embedded performers, heads and complexions drawn by seed {settings.seed}; no person's face."
        flags = f"--performers {settings.performers} --seed {settings.seed}"
    else:
        data = f"{count} registered meshes of {settings.scans and settings.scans.name}."
        flags = f"--scans {settings.scans and settings.scans.name}"
    for name in ("held_out", "components", "color_components", "variance"):
        value = getattr(settings, name)
        flags += "" if value is None else f" --{name.replace('_', '-')} {value}"
    flags += (
        " --scale" * settings.scale + " --no-white-balance" * (not settings.white_balance) + " --half" * settings.half
    )
    colors = (
        "Colours are one a vertex, sRGB; a cast that the whole set shares remains, and so does light from the side."
        if model.color is not None
        else "The meshes brought no colours, so the model has none."
    )
    zoo.save_model(
        model,
        settings.out,
        licence=settings.licence or ("MIT" if settings.performers else "that of the scans"),
        data=data,
        metrics=metrics,
        recipe=f"python -m train.morphable {flags} --out models/{settings.out.name}",
        card=(
            f"Neutral heads as a linear model: a mean and {model.shape.count} components, coefficients in standard "
            f"deviations, millimetres. Good for drawing heads, for holding a registration or a fit to photographs to "
            f"what heads look like, for filling in what a scan does not show. {colors} Tested on {held_out} heads that "
            "it has not learned from; generalisation leaves one head out at a time; specificity is how far its random "
            "heads lie from the nearest it has learned from (root mean squares over the vertices). It knows no "
            "expressions, and no heads unlike those it has learned from: beyond 3 standard deviations it only guesses."
        ),
        settings=effective,
        half=[name for name in _HALF if settings.half and name in model.state_dict()],
    )


def draw(
    model: HeadModel,
    settings: Settings,
    quality: ModelQuality | None,
    learn: Samples,
    test: Samples,
    say: Callable[[str], None],
) -> None:
    """Writes the pictures."""
    folder = settings.pictures or settings.out / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    say("drawing")
    known, others = (
        torch.cat([model.shape.project(part.read(*block)) for block in blocks(part)]) if part.shape[0] else None
        for part in (learn, test)
    )
    assert known is not None
    pictures = {
        "modes": modes_picture(model),
        "random": random_picture(model, seed=settings.seed),
        "morph": morph_picture(model, seed=settings.seed),
        "far": far_picture(model, seed=settings.seed),
        "components": scatter_picture(model.shape, known, others),
    }
    if model.color is not None:
        pictures["color_modes"] = color_modes_picture(model)
    if quality is not None:
        pictures["quality"] = quality_picture(quality)
    for name, picture in pictures.items():
        save_picture(picture, folder / f"{name}.png")


def _source(settings: Settings) -> tuple[Source, int]:
    """The meshes, and how many of them are held out; what cannot work is refused before anything is read."""
    if (settings.scans is None) == (settings.performers <= 0):
        raise TorchfaceError(
            f"found scans={settings.scans} and performers={settings.performers}; expected a folder of registered "
            "meshes, or a number of performers"
        )
    if settings.scans is None:
        held_out = _TESTED_PERFORMERS if settings.held_out is None else settings.held_out
        source = performers(settings.performers + held_out, settings.seed)
    else:
        source = registered(settings.scans)
        held_out = len(source.names) // 10 if settings.held_out is None else settings.held_out
    count = len(source.names) - held_out
    if count < 2 or held_out < 0:
        raise TorchfaceError(
            f"{settings.scans or 'performers'}: found {len(source.names)}, expected at least two to learn from besides "
            f"the {held_out} held out"
        )
    for name in ("components", "color_components"):
        asked = getattr(settings, name)
        if asked is not None and not 1 <= asked < count:
            raise TorchfaceError(f"{name}: found {asked}, expected 1 to {count - 1} with {count} heads to learn from")
    return source, held_out


def _spread(numbers: range, most: int = 60) -> list[int]:
    """At most so many of the numbers, first and last among them."""
    if len(numbers) <= most:
        return list(numbers)
    return sorted({numbers[round(i)] for i in torch.linspace(0, len(numbers) - 1, most).tolist()})


def _counting(say: Callable[[str], None], what: str) -> Callable[[int, int], None]:
    """Says where a fit is, twenty times at most."""

    def count(done: int, total: int) -> None:
        if done % max(1, total // 20) == 0:
            say(f"{what}: {done} of {total} blocks")

    return count


def main() -> None:
    """Parses flags, trains, prints."""
    try:
        trained = train(tyro.cli(Settings, description=__doc__), print)
    except TorchfaceError as error:
        sys.exit(str(error))
    for key, value in trained.metrics.items():
        print(f"{key:40} {value:8.3f}")


if __name__ == "__main__":
    main()
