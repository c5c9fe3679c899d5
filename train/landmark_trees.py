"""``torchface train landmark_trees --data DIR... --out models/NAME``: 68 landmarks of faces in images.

A folder of iBUG's kind holds images with a ``.pts`` beside each; a dlib ``.xml`` names its images itself.
``--performers 2000`` learns from so many rendered images of synthetic people, alone or besides the data.
"""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchface import TorchfaceError, zoo
from torchface.landmarks import LandmarkTrees, TreeSettings
from torchface.landmarks.images.ibug_68 import relative_errors
from torchface.progress import Progress, silent

from .annotated_faces import NO_FACES, Faces, load_faces, rendered_faces
from .model_cards import model_card
from .people_split import held_out_people
from .recipe_settings import RecipeSettings
from .rendered_people.portraits import FaceImageSettings
from .runner import Recipe, Run, recipe


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        data: Folders of images with .pts files, or dlib .xml files.
        performers: So many rendered images of synthetic people.
        held_out: Faces of the data, the last ones and all others of the same people, or rendered images of other
            people, that are kept for the test.
        folders_are_people: Pictures of one folder show one person; else every picture shows a person of its own.
        workers: Processes that render.
        trees: How trees are grown.
        images: What is rendered how widely.
    """

    data: tuple[Path, ...] = ()
    performers: int = 0
    out: Path = Path("models/face_landmarks")
    held_out: int = 0
    folders_are_people: bool = False
    seed: int = 1
    workers: int = 1
    trees: TreeSettings = field(default_factory=TreeSettings)
    images: FaceImageSettings = field(default_factory=FaceImageSettings)


@recipe
def train(settings: Settings, run: Run) -> tuple[LandmarkTrees, Tensor]:
    """Loads or renders, splits, fits, evaluates and saves; the model, and its errors on the faces held out."""
    progress = run.progress
    learn, test = split(settings, progress)
    progress(f"{len(learn)} faces to learn from, {len(test)} to test on")
    model = LandmarkTrees.fit(
        learn.images, learn.boxes, learn.landmarks, settings.trees, progress, checkpoint=run.checkpoint
    )
    errors = evaluate(model, test)
    _save(model, settings, errors, len(learn))
    return model, errors


def split(settings: Settings, progress: Progress | None = None) -> tuple[Faces, Faces]:
    """The faces to learn from, and those to test on."""
    progress = progress or silent
    if not settings.data and settings.performers < 1:
        raise TorchfaceError("found neither data nor performers, expected --data DIR... or --performers NUMBER")
    real = NO_FACES
    for path in settings.data:
        real = real + load_faces(path, settings.folders_are_people)
        progress(f"{path}: {len(real)} faces so far")
    learned, tested = held_out_people(real.people, settings.held_out) if settings.data else ([], [])
    if settings.data and not learned:
        raise TorchfaceError(f"--data: found {len(real)} faces, expected more than the {len(tested)} held out")
    learn, test = real.some(learned), real.some(tested)
    if settings.performers:
        learn = learn + rendered_faces(settings.performers, settings.seed, settings.images, progress, settings.workers)
        if not settings.data:
            seed = settings.seed + 1_000_000
            test = rendered_faces(settings.held_out, seed, settings.images, progress, settings.workers)
    return learn, test


def evaluate(model: LandmarkTrees, faces: Faces) -> Tensor:
    """Errors (M,) over the distance of the outer corners of the eyes."""
    found = [
        model(image[None, None].float() / 255, box[None])  # sizes differ: a face at a time
        for image, box in zip(faces.images, faces.boxes, strict=True)
    ]
    return relative_errors(torch.cat(found), faces.landmarks) if found else torch.zeros(0)


def _save(model: LandmarkTrees, settings: Settings, errors: Tensor, count: int) -> None:
    own = f"{settings.performers} rendered images of the embedded performer; no person's face."
    given = f"{count - settings.performers} faces of {', '.join(path.name for path in settings.data)}"
    data = own if not settings.data else (f"{given}, {own}" if settings.performers else f"{given}.")
    metrics = {}
    if len(errors):
        metrics = {
            "mean error, % of the distance of the eyes' outer corners": 100 * float(errors.mean()),
            "median error, %": 100 * float(errors.median()),
            "share of faces with more than 10 %, %": 100 * float((errors > 0.1).float().mean()),
        }
    card = model_card(
        settings,
        licence="that of the data" if settings.data else "MIT",
        data=data,
        metrics=metrics,
        text=(
            "iBUG's 68 landmarks of faces in grey images, from boxes as OpenCV's Haar cascade gives them or "
            "`landmarks.images.ibug_68.box_around` makes them of landmarks. Good for faces within 40 degrees of "
            f"frontal, 40 pixels or more a box. Tested on {len(errors)} faces that it had not seen."
            + (
                ""
                if settings.data
                else " Learned from rendered people alone: expect two to three times the error on photographs."
            )
        ),
    )
    zoo.save_model(model, settings.out, card, half=("offsets", "thresholds", "bases"))


RECIPE = Recipe(Settings, train, __doc__)

if __name__ == "__main__":
    RECIPE.main()
