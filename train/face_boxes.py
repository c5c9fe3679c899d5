"""``torchface train face_boxes --out models/NAME``: the network that finds faces in whole pictures, at every angle.

Its scenes are put together from rendered people, which are rendered once and kept in ``--pictures``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch

from torchface import zoo
from torchface.errors import ValueRangeError
from torchface.landmarks import BoxNetwork, BoxTrainingSettings, LabelledPicture, NetworkDetector
from torchface.landmarks.images.boxes.face_box import overlaps
from torchface.progress import Progress, silent

from .face_pictures import EACH, StoredCutOuts, StoredPictures, picture_files
from .model_cards import model_card
from .recipe_settings import ANY_DEVICE, RecipeSettings
from .rendered_people.face_scenes import ScenePeople, SceneSettings, face_scene
from .runner import Recipe, Run, metric_lines, recipe

_SAME, _NOTHING = 0.4, 0.3  # overlaps from which a box is the face's, and under which it is none's
_TEST_SIZE = 320  # pixels a side of the scenes that it is tested on


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        folder: Where pictures of people are kept, for other recipes too.
        people: How many of them to render.
        ict: ICT-FaceKit's FaceXModel, whose heads are four people in five; embedded performers alone without.
        held_out: Of them, the last, of people whom no scene that it learns from shows, kept for the test.
        tested: Scenes of those that are held out.
        workers: Processes that render.
        scenes: What is in them.
        training: How it learns.
    """

    folder: Path = Path("out/face_pictures")
    people: int = 9600
    ict: Path | None = None
    out: Path = Path("models/face_boxes")
    held_out: int = 1056
    tested: int = 200
    seed: int = 1
    workers: int = 2
    scenes: SceneSettings = field(default_factory=SceneSettings)
    training: BoxTrainingSettings = field(default_factory=BoxTrainingSettings)

    devices: ClassVar[tuple[str, ...]] = ANY_DEVICE


@recipe
def train(settings: Settings, run: Run) -> tuple[BoxNetwork, dict[str, float]]:
    """Renders, learns, tests and saves; the network, and what was measured on people held out.

    Raises:
        TorchfaceError: too few people, or a file that cannot be used.
    """
    progress = run.progress
    if not (0 < settings.held_out < settings.people and settings.tested > 0):
        raise ValueRangeError(
            f"found held_out {settings.held_out} of {settings.people} people, tested {settings.tested}; expected some "
            "people, not all, and 1 at least"
        )
    files = picture_files(settings.folder, settings.people, settings.seed, settings.ict, settings.workers, progress)
    split = EACH * ((len(StoredPictures(files)) - settings.held_out) // EACH)  # whole people
    people, others = StoredCutOuts(files, 0, split), StoredCutOuts(files, split)
    progress(f"{len(people)} pictures of people to learn from, {len(others)} to test on")
    model = BoxNetwork.fit(
        partial(_scene, people, settings.scenes, settings.seed),
        settings.training,
        progress,
        run.checkpoint,
        {"scenes": settings.scenes, "people": len(people), "ict": settings.ict is not None, "seed": settings.seed},
        run.device,
        run.log,
    )
    measured = evaluate(model, others, settings.tested, settings.seed, progress)
    _save(model, settings, measured, len(people))
    return model, measured


def evaluate(
    model: BoxNetwork, people: ScenePeople, count: int, seed: int, progress: Progress | None = None
) -> dict[str, float]:
    """What is found in scenes of these people: faces, boxes where there is none, how well they fit."""
    progress, detector = progress or silent, NetworkDetector(model)
    settings = SceneSettings(size=_TEST_SIZE, smallest=24.0, largest=0.7 * _TEST_SIZE)
    faces = found = wrong = 0
    fits, angles = [], []
    for number in range(count):  # pictures have different numbers of faces
        scene = face_scene(people, number, settings, seed + 1_000_000)
        seen = detector(scene.image)
        side = scene.faces[:, 2:3]
        truth = torch.cat([scene.faces[:, :2] - side / 2, side, side], 1)
        shared = overlaps(truth, seen.boxes)
        wrong += int((shared < _NOTHING).all(0).sum())
        for row in (~scene.uncertain).nonzero()[:, 0].tolist():
            faces += 1
            if len(seen) and float(shared[row].max()) > _SAME:
                found += 1
                fits.append(float(shared[row].max()))
                off = float(seen.tilts[shared[row].argmax()] - scene.faces[row, 3])
                angles.append(abs(math.degrees(math.remainder(off, 2 * math.pi))))
        progress("testing", number + 1, count)
    return {
        "faces found, %": 100 * found / max(1, faces),
        "boxes where there is no face, in 100 pictures": 100 * wrong / count,
        "median overlap of box and truth, %": 100 * float(torch.tensor(fits or [0.0]).median()),
        "median error of the roll angle, degrees": float(torch.tensor(angles or [180.0]).median()),
    }


def _scene(people: ScenePeople, settings: SceneSettings, seed: int, number: int) -> LabelledPicture:
    return face_scene(people, number, settings, seed)


def _save(model: BoxNetwork, settings: Settings, measured: dict[str, float], count: int) -> None:
    heads = "ICT-FaceKit's heads (MIT) and the embedded performer" if settings.ict else "the embedded performer"
    card = model_card(
        settings,
        licence="MIT",
        data=f"Scenes of {count} rendered pictures of {heads}; no person's photograph.",
        metrics=measured,
        text=(
            "Faces in whole colour or grey pictures: centre, side, score and roll angle of each. Boxes are those of "
            "`torchface.landmarks.images.ibug_68.turned_box`. Good for faces from 24 pixels in pictures of 640. Tested "
            f"on {settings.tested} scenes of {_TEST_SIZE} pixels with people that it had not seen. It has seen no "
            "photograph: in real ones small faces of groups are missed where cascades find them, boxes fit more "
            "loosely, and faces turned by more than 40 degrees are found best in turned copies of the picture "
            "(`torchface.landmarks.images.boxes.find_faces.find_in_quarter_turns`)."
        ),
    )
    zoo.save_model(
        model, settings.out, card, half=[name for name, value in model.state_dict().items() if value.ndim == 4]
    )


RECIPE = Recipe(Settings, train, __doc__, lambda _, trained: metric_lines(trained[1], "8.2f"))

if __name__ == "__main__":
    RECIPE.main()
