"""``torchface train landmarks --data DIR... --out models/NAME``: 68 landmarks of faces in images.

A folder of iBUG's kind holds images with a ``.pts`` beside each; a dlib ``.xml`` names its images itself.
``--performers 2000`` learns from so many rendered images of synthetic people, alone or besides the data.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

import torch
from torch import Tensor

from torchface import TorchfaceError, zoo
from torchface.color_space import grey_images
from torchface.errors import FileFormatError
from torchface.io.images.image_files import load_image
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.io.landmarks.landmark_points import load_landmark_points
from torchface.landmarks import LandmarkTrees, TreeSettings
from torchface.landmarks.images.ibug_68 import box_around, relative_errors
from torchface.progress import Progress, silent
from torchface.synthetic.stages.portraits import FaceImage, FaceImageSettings, face_images

from .model_cards import model_card
from .recipe_settings import RecipeSettings
from .runner import Recipe, Run, metric_lines, recipe

_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")
_MAX_BOX = 240.0  # pixels a side; larger faces are made smaller, as pairs of pixels say no more than this anyway
_PART = 60  # images that a process renders at once
_AROUND = 0.8  # of the box that is kept on every side


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        data: Folders of images with .pts files, or dlib .xml files.
        performers: So many rendered images of synthetic people.
        held_out: Faces of the data, the last ones, or rendered images of other people, that are kept for the test.
        workers: Processes that render.
        trees: How trees are grown.
        images: What is rendered how widely.
    """

    data: tuple[Path, ...] = ()
    performers: int = 0
    out: Path = Path("models/face_landmarks")
    held_out: int = 0
    seed: int = 1
    workers: int = 1
    trees: TreeSettings = field(default_factory=TreeSettings)
    images: FaceImageSettings = field(default_factory=FaceImageSettings)


@dataclass(frozen=True, eq=False)
class Faces:
    """Grey images uint8 (H,W), boxes (M,4) and landmarks (M,68,2) in their pixels."""

    images: list[Tensor]
    boxes: Tensor
    landmarks: Tensor

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, rows: slice) -> Faces:
        return Faces(self.images[rows], self.boxes[rows], self.landmarks[rows])

    def __add__(self, other: Faces) -> Faces:
        return Faces(
            self.images + other.images,
            torch.cat([self.boxes, other.boxes]),
            torch.cat([self.landmarks, other.landmarks]),
        )


NO_FACES = Faces([], torch.zeros(0, 4), torch.zeros(0, 68, 2))


@recipe
def train(settings: Settings, run: Run) -> tuple[LandmarkTrees, Tensor]:
    """Loads or renders, splits, fits, evaluates and saves; the model, and its errors on the faces held out.

    Raises:
        TorchfaceError: neither data nor performers, too few faces, or a file that cannot be used.
    """
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
        real = real + load_faces(path)
        progress(f"{path}: {len(real)} faces so far")
    kept = settings.held_out if settings.data else 0
    if settings.data and len(real) <= kept:
        raise TorchfaceError(f"data: found {len(real)} faces, expected more than the {kept} held out")
    learn, test = real[: len(real) - kept], real[len(real) - kept :]
    if settings.performers:
        learn = learn + rendered_faces(settings.performers, settings.seed, settings.images, progress, settings.workers)
        if not settings.data:
            seed = settings.seed + 1_000_000
            test = rendered_faces(settings.held_out, seed, settings.images, progress, settings.workers)
    return learn, test


def load_faces(path: Path) -> Faces:
    """The annotated faces of a folder of ``.pts`` files or of a dlib ``.xml``; those without all 68 are left out.

    Raises:
        FileFormatError: neither of both, no annotated face in it, or an image is missing.
    """
    found: list[tuple[Path, Tensor]] = []
    if path.suffix.lower() == ".xml":
        for face in load_dlib_faces(path):
            if face.points.shape == (68, 2) and bool(torch.isfinite(face.points).all()):
                found.append((_beside(path, face.image), face.points))
    elif path.is_dir():
        for file in sorted(path.rglob("*.pts")):
            pictures = [file.with_suffix(ending) for ending in _ENDINGS if file.with_suffix(ending).is_file()]
            if not pictures:
                raise FileFormatError(f"{file}: found no image of the same name, expected one beside it")
            found.append((pictures[0], load_landmark_points(file).ibug()))
    else:
        raise FileFormatError(f"{path}: found no folder and no .xml, expected iBUG's .pts files or dlib's XML")
    if not found:
        raise FileFormatError(f"{path}: found no face with 68 landmarks, expected at least one")
    known: dict[Path, Tensor] = {}
    faces = NO_FACES
    for picture, points in found:
        if picture not in known:
            known = {picture: grey_images(load_image(picture)[None])[0, 0]}  # faces of an image come in a row
        faces = faces + _cropped(known[picture], points.float())
    return faces


def rendered_faces(
    count: int,
    seed: int,
    settings: FaceImageSettings | None = None,
    progress: Progress | None = None,
    workers: int = 1,
) -> Faces:
    """Images of synthetic people; how many processes render them does not change them."""
    progress = progress or silent
    parts = [(seed, settings, start, min(_PART, count - start)) for start in range(0, count, _PART)]
    progress = progress or silent
    pictures: list[FaceImage] = []
    with ExitStack() as stack:
        rendered: Iterable[list[FaceImage]] = map(_rendered_part, parts)
        if workers > 1:
            # Spawned: what a process inherits of torch's threads may not survive a fork.
            pool = ProcessPoolExecutor(workers, get_context("spawn"))
            rendered = stack.enter_context(pool).map(_rendered_part, parts)
        for part in rendered:
            pictures += part
            progress("rendering portraits", len(pictures), count)
    if not pictures:
        return NO_FACES
    return Faces(
        [picture.image for picture in pictures],
        torch.stack([picture.box for picture in pictures]),
        torch.stack([picture.landmarks for picture in pictures]),
    )


def _rendered_part(part: tuple[int, FaceImageSettings | None, int, int]) -> list[FaceImage]:
    seed, settings, first, count = part
    return list(face_images(count, seed, settings, first=first))


def evaluate(model: LandmarkTrees, faces: Faces) -> Tensor:
    """Errors (M,) over the distance of the outer corners of the eyes."""
    found = [
        model(image[None, None].float() / 255, box[None])  # sizes differ: a face at a time
        for image, box in zip(faces.images, faces.boxes, strict=True)
    ]
    return relative_errors(torch.cat(found), faces.landmarks) if found else torch.zeros(0)


def _beside(path: Path, name: str) -> Path:
    """An image that an XML names; one outside of its folder is refused."""
    picture = path.parent / name
    if not picture.resolve().is_relative_to(path.parent.resolve()):
        raise FileFormatError(f"{path}: found the image {name!r:.80}, expected one in the same folder")
    return picture


def _cropped(grey: Tensor, landmarks: Tensor) -> Faces:
    """A face cut out of an image (H,W) in [0,1], smaller where it is very large."""
    box = box_around(landmarks)
    high, wide = grey.shape
    low = (box[:2] - _AROUND * box[2:]).floor().clamp(min=0).minimum(torch.tensor([wide - 1.0, high - 1.0]))
    end = (box[:2] + (1 + _AROUND) * box[2:]).ceil().clamp(min=1).minimum(torch.tensor([float(wide), float(high)]))
    end = torch.maximum(end, low + 1)
    (x, y), (right, bottom) = low.long().tolist(), end.long().tolist()
    part, zoom = grey[y:bottom, x:right], min(1.0, _MAX_BOX / float(box[2]))
    landmarks = landmarks - low
    if zoom < 1:
        size = [max(1, round(side * zoom)) for side in part.shape]
        part = torch.nn.functional.interpolate(part[None, None], size, mode="bilinear", antialias=True)[0, 0]
        scale = torch.tensor([part.shape[1] / (right - x), part.shape[0] / (bottom - y)])
        landmarks = (landmarks + 0.5) * scale - 0.5
    stored = (255 * part).round().clamp(0, 255).to(torch.uint8).contiguous()
    return Faces([stored], box_around(landmarks)[None], landmarks[None])


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


RECIPE = Recipe(
    Settings, train, __doc__, lambda settings, _: metric_lines(zoo.describe(settings.out.resolve()).metrics)
)

if __name__ == "__main__":
    RECIPE.main()
