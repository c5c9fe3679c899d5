"""``torchface train face_boxes --out models/NAME``: the network that finds faces in whole pictures, at every angle.

Its scenes are put together from rendered people, which are rendered once and kept in ``--folder``.
"""

import math
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import torch

from torchface import zoo
from torchface.errors import ValueRangeError
from torchface.landmarks import BoxNetwork, BoxTrainingSettings, LabelledPicture, NetworkDetector
from torchface.landmarks.images.boxes.box_training import Pictures
from torchface.landmarks.images.boxes.face_box import overlaps
from torchface.progress import Progress, silent

from .face_pictures import EACH, FACES, StoredCutOuts, StoredPictures
from .model_cards import model_card
from .recipe_settings import ANY_DEVICE, RecipeSettings
from .rendered_files import rendered_files
from .rendered_people.face_scenes import ScenePeople, SceneSettings, empty_scene, face_scene
from .rendered_people.scene_clutter import clutter
from .runner import Recipe, Run, metric_lines, recipe

_SAME, _NOTHING = 0.4, 0.3  # overlaps from which a box is the face's, and under which it is none's
_TEST_SIZE = 320  # pixels a side of the scenes that it is tested on
_MISTAKEN, _PIECES = 0.25, 0.15  # score of what is taken for a face, and share of pictures that show such
_LARGEST_SHOWN = 44  # pixels a side of a face in the copy of an image in which it is found


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        folder: Where pictures of people are kept, for other recipes too.
        people: How many of them to render.
        ict: ICT-FaceKit's FaceXModel, whose heads are four people in five; embedded performers alone without.
        held_out: Of them, the last, of people whom no scene that it learns from shows, kept for the test.
        tested: Scenes of those that are held out.
        mined: Pictures without people in which mistakes are looked for when it has learned; it learns again as long,
            with those.
        workers: Processes that render.
        scenes: What is in them.
        training: How it learns.
    """

    folder: Path = Path("out/face_pictures")
    people: int = 9600
    ict: Path | None = None
    out: Path = Path("models/face_boxes")
    held_out: int = 480
    tested: int = 200
    mined: int = 3000
    seed: int = 1
    workers: int = 2
    scenes: SceneSettings = field(default_factory=SceneSettings)
    training: BoxTrainingSettings = field(default_factory=BoxTrainingSettings)

    devices: ClassVar[tuple[str, ...]] = ANY_DEVICE


@recipe
def train(settings: Settings, run: Run) -> tuple[BoxNetwork, dict[str, float]]:
    """Renders, learns, tests and saves; the network, and what was measured on people held out."""
    progress = run.progress
    if not (0 < settings.held_out < settings.people and settings.tested > 0):
        raise ValueRangeError(
            f"found --held-out {settings.held_out} of --people {settings.people}, --tested {settings.tested}; expected "
            "some of the people, not all, and 1 at least"
        )
    files = rendered_files(
        FACES, settings.folder, settings.people, settings.seed, settings.ict, settings.workers, progress
    )
    split = EACH * ((len(StoredPictures(files)) - settings.held_out) // EACH)  # whole people
    people, others = StoredCutOuts(files, 0, split), StoredCutOuts(files, split)
    progress(f"{len(people)} pictures of people to learn from, {len(others)} to test on")
    source = {"scenes": settings.scenes, "people": len(people), "ict": settings.ict is not None, "seed": settings.seed}
    draw = partial(_scene, people, settings.scenes, settings.seed)
    model = BoxNetwork.fit(draw, settings.training, progress, run.checkpoint, source, run.device, run.log)
    mistaken = mined_pieces(model, settings.mined, settings.scenes.size, settings.seed, progress)
    draw = partial(_scene_or_piece, draw, mistaken, settings.seed + 1)
    again = replace(settings.training, rate=settings.training.rate / 2)
    checkpoint = run.checkpoint.with_name(f"again_{run.checkpoint.name}")
    model = BoxNetwork.fit(
        draw, again, progress, checkpoint, source | {"mined": settings.mined}, run.device, run.log, model
    )
    measured = evaluate(model, others, settings.tested, settings.seed, progress)
    _save(model, settings, measured, len(people))
    return model, measured


def evaluate(
    model: BoxNetwork, people: ScenePeople, count: int, seed: int, progress: Progress | None = None
) -> dict[str, float]:
    """What is found in scenes of these people: faces, boxes where there is none, how well they fit."""
    progress, detector = progress or silent, NetworkDetector(model)
    settings = SceneSettings(size=_TEST_SIZE, smallest=20.0, largest=0.7 * _TEST_SIZE, huge=0.0)
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


def mined_pieces(
    model: BoxNetwork, count: int, size: int, seed: int, progress: Progress | None = None
) -> list[np.ndarray]:
    """Squares (S,S,3) round what a network takes for faces in pictures without people."""
    progress, detector = progress or silent, NetworkDetector(model, _MISTAKEN)
    pieces: list[np.ndarray] = []
    for number in range(count):  # pictures have different numbers of mistakes
        rng = np.random.default_rng((seed, number, 3))
        picture = empty_scene(clutter(_TEST_SIZE, _TEST_SIZE, rng), rng).image
        image = picture.permute(1, 2, 0).numpy()
        for x, y, side, _ in detector(picture).boxes.tolist():
            halvings = max(0, math.ceil(math.log2(side / _LARGEST_SHOWN)))  # to the copy in which it was seen
            scale = 0.5**halvings
            way = np.array(
                [[scale, 0, size / 2 - scale * (x + side / 2)], [0, scale, size / 2 - scale * (y + side / 2)]]
            )
            smooth = cv2.GaussianBlur(image, (0, 0), 0.5 / scale) if halvings else image
            pieces.append(cv2.warpAffine(smooth, way, (size, size), borderMode=cv2.BORDER_REPLICATE))
        progress("looking for mistakes", number + 1, count)
    return pieces


def _scene(people: ScenePeople, settings: SceneSettings, seed: int, number: int) -> LabelledPicture:
    return face_scene(people, number, settings, seed)


def _scene_or_piece(draw: Pictures, pieces: list[np.ndarray], seed: int, number: int) -> LabelledPicture:
    """A scene, or, one in eight, what was taken for a face."""
    rng = np.random.default_rng((seed, number, 2))
    if not pieces or rng.random() >= _PIECES:
        return draw(number)
    return empty_scene(pieces[int(rng.integers(len(pieces)))], rng)


def _save(model: BoxNetwork, settings: Settings, measured: dict[str, float], count: int) -> None:
    heads = "ICT-FaceKit's heads (MIT) and the embedded performer" if settings.ict else "the embedded performer"
    card = model_card(
        settings,
        licence="MIT",
        data=f"Scenes of {count} rendered pictures of {heads}; no person's photograph.",
        metrics=measured,
        text=(
            "Faces at every roll angle in whole colour or grey pictures: centre, side, score and roll angle of each. "
            "Boxes are those of `torchface.landmarks.images.ibug_68.turned_box`. Good for faces from 20 pixels in "
            f"pictures of 896. Tested on {settings.tested} scenes of {_TEST_SIZE} pixels with people that it had not "
            "seen, three in four of them at any roll angle. It has seen no photograph."
        ),
    )
    zoo.save_model(
        model, settings.out, card, half=[name for name, value in model.state_dict().items() if value.ndim == 4]
    )


RECIPE = Recipe(Settings, train, __doc__, lambda _, trained: metric_lines(trained[1], "8.2f"))

if __name__ == "__main__":
    RECIPE.main()
