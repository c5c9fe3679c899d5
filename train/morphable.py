"""``torchface train morphable --scans DIR --out models/NAME``: a head model, shape and colour, of registered meshes.

``--ict FaceXModel`` makes one of ICT-FaceKit's identity modes, which come from light-stage scans of people, with its 53
expressions as the rig; ``--published FILE`` one of GNM Head, FLAME or Basel, with ARKit's shapes made on it;
``--performers 200`` learns from so many embedded performers, and needs no file. Killed and started again, a run goes on
where it was.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import torchface
from torchface import BlendshapeRig, Mesh, TorchfaceError, load_mesh, load_rig, zoo
from torchface.errors import FileFormatError
from torchface.files.model_roots import is_checkout
from torchface.io import load_head_model_file, load_ict_facekit, load_identity_modes
from torchface.io.rig_files import SCENE_ENDINGS
from torchface.io.rigs.ict_facekit import region
from torchface.mesh import submesh
from torchface.modeling import HeadModel, MorphableModel
from torchface.modeling.rigging.ict_heads import mended_head
from torchface.progress import Progress
from torchface.workflows.arkit.arkit_rig import published_head
from torchface.zoo.model_folders import HOME

from .head_colors import fitted_colors
from .head_figures import draw
from .head_measures import card_text, cross_validated, head_quality, measured
from .head_samples import Source, aligned_samples, gather, performers, registered, vertex_colored
from .model_cards import model_card
from .model_quality import ModelQuality
from .recipe_settings import RecipeSettings
from .runner import Recipe, Run, metric_lines, recipe

_OUT = Path("models/head")
_TESTED_PERFORMERS = 20
_MANY, _FOLDS, _MIN_FOLDS = 100, 10, 3  # meshes; of fewer than the first, a tenth says too little
_MEASURES = (
    "; generalisation leaves one head out at a time; specificity is how far its random heads lie from the nearest it "
    "has learned from (root mean squares over the vertices)."
)
_HALF = ("shape.components", "color.components")


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        scans: Folder of registered meshes, all of one topology, in any place; what `torchface register` writes.
        ict: Take ICT-FaceKit's `FaceXModel` folder instead: its neutral, identity modes and expressions. Without --out
            the model is `people` in $TORCHFACE_HOME, else the checkout's models, where `torchface fit` finds it.
        published: Take a head model as others publish it instead: GNM Head's gnm_head.npz, FLAME's arrays as .npz or
            .safetensors, Basel's .h5. It gets ARKit's shapes on its own vertices, as by `torchface arkit`, and lies
            where --ict's model does.
        performers: Learn from so many embedded performers instead of a folder's meshes.
        template: The template that the meshes were registered with, a mesh or a rig (.glb, a folder of OBJ files,
            `FaceXModel`): says where and how upright the heads are to stand, and brings annotations. A rig travels with
            the model, so that `torchface fit` needs no other. The first mesh where absent, set upright by its landmarks
            if it has any.
        part: The region of template or `FaceXModel` that the heads have, such as face.
        unit: Of the scans' files (um, mm, cm, m, in) where it is not the format's own; of the template's if no rig.
        held_out: How many meshes, the last by name, are kept for the test; or how many more performers are drawn for
            it. If absent 20 performers, a tenth of 100 meshes and more; of fewer meshes each is left out once.
        components: How many components of shape; all if absent, at most 200.
        color_components: How many components of colour; likewise.
        variance: Keep as few components of shape as hold this share of the variance.
        scale: Take the heads' sizes off as well as their places.
        white_balance: Free the colours from each scan's exposure and white balance; performers have none.
        half: Store components in half precision.
        pictures: Folder for the pictures; OUT/pictures if absent.
    """

    scans: Path | None = None
    ict: Path | None = None
    published: Path | None = None
    performers: int = 0
    out: Path = _OUT
    template: Path | None = None
    part: str | None = None
    unit: str | None = None
    held_out: int | None = None
    components: int | None = None
    color_components: int | None = None
    variance: float | None = None
    scale: bool = False
    white_balance: bool = True
    half: bool = False
    seed: int = 7
    pictures: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.ict is not None or self.published is not None) and self.out == _OUT:
            object.__setattr__(self, "out", _own_models() / "people")


def _own_models() -> Path:
    """The folder for further models, which go by their names from it: ``$TORCHFACE_HOME``, the checkout's, else
    ``models`` in the working directory, whose models go by their paths alone."""
    if home := os.environ.get(HOME):
        return Path(home)
    package = Path(torchface.__file__).resolve().parent
    return package.parent / "models" if is_checkout(package.parent, package.name) else Path("models")


@dataclass(frozen=True, eq=False)
class Trained:
    """The model, what was measured, and the curves."""

    model: HeadModel
    metrics: dict[str, float]
    quality: ModelQuality | None


@recipe
def train(settings: Settings, run: Run) -> Trained:
    """Loads, aligns, splits, fits, evaluates, saves, draws."""
    progress = run.progress
    _check_one_source(settings)
    if settings.ict is not None:
        progress("reading the modes and the expressions")
        return _as_given(ict_head_model(settings.ict, settings.part, settings.components), settings, progress)
    if settings.published is not None:
        model = published_head(settings.published, settings.components, progress)
        if settings.part is not None:
            model = model.part(region(model.template(), settings.part))
        return _as_given(model, settings, progress)
    source, held_out = _source(settings)
    template, rig = (
        (None, None) if settings.template is None else load_template(settings.template, settings.part, settings.unit)
    )
    work = run.work
    gathered = gather(source, held_out, work, template, progress)
    count = len(gathered.shapes) - gathered.held_out
    progress(f"{count} heads to learn from, {gathered.held_out} to test on")
    progress("aligning the heads with each other")
    learn, test = aligned_samples(gathered, settings.scale)
    progress("fitting the shape")
    shape = MorphableModel.fit(learn, settings.components, work / "shape", progress)
    if settings.variance is not None:
        shape = shape.truncate(variance=settings.variance)
    balance = settings.white_balance and not settings.performers
    color, test_colors = fitted_colors(gathered, balance, settings.color_components, work / "color", progress)
    model = HeadModel.on(gathered.template, shape, color, rig)
    progress("measuring")
    quality = head_quality(learn, count, shape.count, settings.seed)
    metrics = measured(model, quality, test, test_colors)
    folds = 0
    if not gathered.held_out and count >= _MIN_FOLDS:
        folds = min(count, _FOLDS)
        progress(f"leaving heads out in {folds} turns")
        metrics |= cross_validated(learn, folds, settings.components)
    save(model, settings, metrics, count, gathered.held_out, folds)
    draw(model, settings.pictures or settings.out / "pictures", settings.seed, quality, learn, test, progress)
    return Trained(model, metrics, quality)


def _as_given(model: HeadModel, settings: Settings, progress: Progress) -> Trained:
    """A model of its authors' own modes: nothing is learned, so nothing is held out."""
    deviations = model.shape.modes.square().sum((0, 2)).sqrt()
    metrics = {
        "shape components": float(model.shape.count),
        "heads from the mean, root mean square mm": float(deviations.mean()),
    }
    save(model, settings, metrics, 0, 0, 0)
    draw(model, settings.pictures or settings.out / "pictures", settings.seed, None, None, None, progress)
    return Trained(model, metrics, None)


def save(
    model: HeadModel, settings: Settings, metrics: dict[str, float], count: int, held_out: int, folds: int
) -> None:
    """Writes the model with its effective settings, measured errors and card."""
    if settings.performers:
        data = f"{count} embedded performers, heads and complexions drawn by seed {settings.seed}; no person's face."
    elif settings.ict is not None:
        data = f"{model.shape.count} identity modes of ICT-FaceKit's FaceXModel, made of light-stage scans of people."
    elif settings.published is not None:
        data = f"{model.shape.count} identity modes of {settings.published.name}, as its authors publish it."
    else:
        data = f"{count} registered meshes of {settings.scans and settings.scans.name}."
    if folds:
        tested = f"Tested on all {count} heads, each left out of the model once, in {folds} turns{_MEASURES}"
    elif settings.ict is not None or settings.published is not None:
        tested = "Nothing was held out: the modes are as their authors give them."
    else:
        tested = f"Tested on {held_out} heads that it has not learned from{_MEASURES}"
    free = "MIT" if settings.performers else "MIT, as ICT-FaceKit" if settings.ict is not None else "that of the scans"
    free = free if settings.published is None else load_head_model_file(settings.published).licence
    card = model_card(settings, licence=free, data=data, metrics=metrics, text=card_text(model, tested))
    zoo.save_model(
        model, settings.out, card, half=[name for name in _HALF if settings.half and name in model.state_dict()]
    )


def _check_one_source(settings: Settings) -> None:
    given = (settings.scans, settings.ict, settings.published)
    if sum(one is not None for one in given) + (settings.performers > 0) != 1:
        raise TorchfaceError(
            f"found --scans {settings.scans}, --ict {settings.ict}, --published {settings.published}, --performers "
            f"{settings.performers}; expected one of a folder of registered meshes, ICT-FaceKit's FaceXModel, a head "
            "model's file, and a number of performers"
        )


def _source(settings: Settings) -> tuple[Source, int]:
    """The meshes, and how many of them are held out; what cannot work is refused before anything is read."""
    if settings.scans is None:
        held_out = _TESTED_PERFORMERS if settings.held_out is None else settings.held_out
        source = performers(settings.performers + held_out, settings.seed)
    else:
        source = registered(settings.scans, settings.unit)
        few = len(source.names) < _MANY
        held_out = (0 if few else len(source.names) // 10) if settings.held_out is None else settings.held_out
    count = len(source.names) - held_out
    if count < 2 or held_out < 0:
        raise TorchfaceError(
            f"{settings.scans or '--performers'}: found {len(source.names)}, expected at least two to learn from "
            f"besides the {held_out} held out"
        )
    for name in ("components", "color_components"):
        asked = getattr(settings, name)
        if asked is not None and not 1 <= asked < count:
            flag = f"--{name.replace('_', '-')}"
            raise TorchfaceError(f"{flag}: found {asked}, expected 1 to {count - 1} with {count} heads to learn from")
    return source, held_out


def ict_head_model(folder: Path, part: str | None = None, components: int | None = None) -> HeadModel:
    """The identity modes, all or some, of ICT-FaceKit's ``FaceXModel`` as a head model, or a part of it, with its
    expressions; lips meet at rest, blinks shut the eyes, and an open mouth shows teeth."""
    rig, modes = load_ict_facekit(folder), load_identity_modes(folder, components).deltas
    rig, modes = mended_head(rig, modes)
    deviations = modes.flatten(1).norm(dim=1)
    shape = MorphableModel(rig.vertices, modes / deviations[:, None, None], deviations)
    model = HeadModel.on(rig.neutral, shape, rig=rig)
    return model if part is None else model.part(region(rig.neutral, part))


def load_template(path: Path, part: str | None = None, unit: str | None = None) -> tuple[Mesh, BlendshapeRig | None]:
    """The neutral of a rig, and the rig; or a mesh alone, in ``unit``."""
    if path.is_dir() or path.suffix.lower() in SCENE_ENDINGS:
        try:
            rig = load_rig(path, part=part)
        except FileFormatError:  # no shapes in it: a mesh
            if path.is_dir():
                raise
        else:
            neutral = vertex_colored(rig.neutral)
            return neutral, BlendshapeRig(neutral, rig.deltas, rig.names)
    mesh = load_mesh(path, unit)
    return mesh if part is None else submesh(mesh, region(mesh, part)).mesh, None


def _told(settings: Settings, trained: Trained) -> list[str]:
    """What was measured, and who takes the model up."""
    lines = metric_lines(trained.metrics)
    if settings.out.parent == _own_models():
        lines.append("`torchface fit` and `track` take this model where none is named")
    return lines


RECIPE = Recipe(Settings, train, __doc__, _told)

if __name__ == "__main__":
    RECIPE.main()
