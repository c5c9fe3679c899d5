"""``torchface train expression --pairs DIR --out models/NAME``: expressions predicted from the neutral face.

``--performers 60`` learns from so many embedded performers instead, and needs no file.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface import BlendshapeRig, TorchfaceError, load_rig, zoo
from torchface.errors import NameMismatchError
from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder, visible_files
from torchface.geometry.similarity import similarity_transform
from torchface.modeling import ExpressionRegression, ExpressionSettings
from torchface.progress import Progress
from torchface.rendering.compositing import save_rendered_image
from torchface.synthetic import draw_identities, performer

from .expression_table import Comparison, compare, picture
from .head_samples import check_triangles
from .model_cards import model_card
from .people_samples import People, warn_of_exchanged
from .people_samples import gather as gather_people
from .recipe_settings import RecipeSettings
from .runner import Recipe, Run, recipe

_LEAST = 3  # people
_METHOD = "a person's expressions/1"
# Of the robust alignment, millimetres: how far off counts half, round by round, and what is too little to move.
_HALF_AT, _LEAST_MOTION = (3.0, 2.0, 1.4, 1.0, 0.7, 0.5, 0.35, 0.25, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2), 0.01


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        pairs: Folder with an entry a person: a .glb, or a folder of OBJ files, neutral.obj and one an expression, all
            of one topology, registered.
        performers: Learn from so many embedded performers instead.
        expressions: Which to learn, such as jawOpen mouthSmileLeft+mouthSmileRight; all that everyone has, if absent.
        template: A rig whose shapes deformation transfer takes; the mean of the other people if absent.
        neutral_components: How many, at most; None chooses by leaving out one after the other.
        offset_components: Likewise.
        ridge: As a share of the neutrals' mean variance a component; None chooses it.
        align: Align each expression with its neutral by what does not move, rotation and translation only.
        compared: Leave one out for the table of errors; of more than a hundred people the last fifty together.
        pictured: How many of those left out, the first, are shown with what each method makes of them.
    """

    pairs: Path | None = None
    performers: int = 0
    expressions: tuple[str, ...] = ()
    out: Path = Path("models/expressions")
    template: Path | None = None
    neutral_components: int | None = 14
    offset_components: int | None = 13
    ridge: float | None = 0.0
    align: bool = True
    compared: bool = True
    pictured: int = 4


@dataclass(frozen=True, eq=False)
class Trained:
    """A regression, and the table of errors of those left out."""

    model: ExpressionRegression
    comparison: Comparison | None


@recipe
def train(settings: Settings, run: Run) -> Trained:
    """Gathers on disk, aligned, leaves one out after the other, fits, saves."""
    progress = run.progress
    people = gather(settings, run.work, progress)
    if settings.pairs is not None:
        warn_of_exchanged(people, str(settings.pairs))
    progress(f"{len(people.who)} people, {len(people.names)} expressions")
    comparison = None
    if settings.compared:
        template = None if settings.template is None else _template(settings.template, people)
        comparison = compare(people, lambda rest: fit(rest, settings, progress), template, settings.pictured, progress)
    model = fit(people, settings, progress)
    if comparison is not None:
        assert model.errors is not None
        model.errors.copy_(comparison.expected())
    save(model, people, comparison, settings)
    return Trained(model, comparison)


def _template(path: Path, people: People) -> BlendshapeRig:
    """The people's expressions of a rig of their topology."""
    rig = load_rig(path)
    check_triangles(people.template, rig.neutral, str(path), people.who[0])
    return selected(rig, people.names, path)


def fit(people: People, settings: Settings, progress: Progress | None = None) -> ExpressionRegression:
    """The regression of these people."""
    return ExpressionRegression.fit(
        people.neutrals,
        people.expressions,
        ExpressionSettings(settings.neutral_components, settings.offset_components, settings.ridge),
        people.names,
        people.template.fingerprint(),
        progress=progress,
    )


def gather(settings: Settings, work: Path, progress: Progress) -> People:
    """The people of a folder, or performers, kept in a folder; one is in memory at a time, or all if they are few."""
    if (settings.pairs is None) == (settings.performers == 0):
        raise TorchfaceError(
            "found neither --pairs nor --performers, or both; expected one: --pairs DIR or --performers COUNT"
        )
    if settings.pairs is None:
        if settings.performers < _LEAST:
            raise TorchfaceError(f"--performers: found {settings.performers}, expected at least {_LEAST}")
        identities = draw_identities(settings.performers, torch.Generator().manual_seed(settings.seed))
        return gather_people(
            [f"performer{number:03d}" for number in range(settings.performers)],
            lambda number: selected(performer(identities[number], texture=False), settings.expressions, "performers"),
            lambda number: content_key(_METHOD, identity=identities[number], expressions=settings.expressions),
            work,
            "performers",
            progress,
        )
    paths = entries(settings.pairs)
    return gather_people(
        [path.name for path in paths],
        lambda number: read(paths[number], settings),
        lambda number: content_key(
            _METHOD, files=paths[number], expressions=settings.expressions, align=settings.align
        ),
        work,
        str(settings.pairs),
        progress,
    )


def entries(folder: Path) -> list[Path]:
    """An entry a person, sorted by name."""
    if not folder.is_dir():
        raise TorchfaceError(f"{folder}: found no such folder, expected one with an entry a person")
    entries_found = [path for path in visible_files(folder) if path.is_dir() or path.suffix in (".glb", ".gltf")]
    if len(entries_found) < _LEAST:
        people = "1 person" if len(entries_found) == 1 else f"{len(entries_found)} people"
        raise TorchfaceError(f"{folder}: found {people}, expected at least three: a .glb or a folder each")
    return entries_found


def read(path: Path, settings: Settings) -> BlendshapeRig:
    """One person's expressions, aligned with the neutral."""
    rig = selected(load_rig(path), settings.expressions, path)
    if not settings.align:
        return rig
    settled = [settle(rig.vertices, rig.vertices + delta) - rig.vertices for delta in rig.deltas]
    return BlendshapeRig(rig.neutral, torch.stack(settled), rig.names)


def selected(rig: BlendshapeRig, expressions: tuple[str, ...], source: Path | str) -> BlendshapeRig:
    """The rig of these expressions; one with plus signs that is no shape itself is the sum of the shapes between."""
    if not expressions:
        return rig
    parts = [[name] if name in rig.names else name.split("+") for name in expressions]
    lacking = list(dict.fromkeys(part for some in parts for part in some if part not in rig.names))
    if lacking:
        shown = ", ".join(rig.names[:5]) + (", ..." if len(rig.names) > 5 else "")
        raise NameMismatchError(
            f"{source}: found no shape {', '.join(map(repr, lacking))} among {len(rig.names)} ({shown}), expected "
            f"those of {', '.join(expressions)}; choose by --expressions what it has, or give another file"
        )
    deltas = [rig.deltas[rig.index(some)].sum(0) for some in parts]
    return BlendshapeRig(rig.neutral, torch.stack(deltas), expressions)


def save(model: ExpressionRegression, people: People, comparison: Comparison | None, settings: Settings) -> None:
    """Writes the model with its table, card and picture."""
    if settings.performers:
        data = f"{len(people.who)} embedded performers drawn by seed {settings.seed}; no person's face."
    else:
        data = f"{len(people.who)} people of {settings.pairs and settings.pairs.name}."
    card = model_card(
        settings,
        licence="MIT" if settings.performers else "that of the scans",
        data=data,
        metrics={} if comparison is None else comparison.metrics(),
        text=(
            f"Predicts {', '.join(people.names)} from a neutral face of the same topology: linear, "
            f"{len(model.neutral_components)} components of the part that moves to {len(model.offset_components)} of "
            "the offsets. Good for a first rig of a person of whom there is one scan; where there are scans of "
            f"expressions, learn from those. {_tested(comparison)}It knows only people like those it has learned from."
        ),
    )
    zoo.save_model(model, settings.out, card, half=("neutral_components", "offset_mean", "offset_components"))
    if comparison is not None and comparison.predicted:
        folder = settings.out / "pictures"
        make_folder(folder)
        for row, name in enumerate(people.names[:3]):
            save_rendered_image(picture(people, comparison, row), folder / f"{name}.png")


def _tested(comparison: Comparison | None) -> str:
    """How the card's figures were measured."""
    if comparison is None:
        return ""
    tested = len(comparison.squared)
    who = "one person after the other" if comparison.learned < tested else f"the last {tested} people together"
    return (
        f"Measured by leaving out {who}, against deformation transfer and the mean offset of the others: in how many "
        "cases each has the lowest error, and the squared error summed over the vertices. "
    )


def settle(neutral: Tensor, expression: Tensor) -> Tensor:
    """An expression (V,3) moved onto its neutral by what stays: far-off vertices lose their say, round by round."""
    moved = expression
    for half in _HALF_AT:
        distance = (moved - neutral).norm(dim=-1)
        weights = 1 / (1 + (distance / half) ** 2) ** 2
        pose = similarity_transform(expression[None], neutral[None], weights[None], scale=False)
        moved = pose.apply(expression[None])[0]
    return expression if float((moved - expression).norm(dim=-1).max()) < _LEAST_MOTION else moved


RECIPE = Recipe(
    Settings, train, __doc__, lambda _, trained: [] if trained.comparison is None else [str(trained.comparison)]
)

if __name__ == "__main__":
    RECIPE.main()
