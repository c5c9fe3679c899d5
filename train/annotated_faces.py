"""Faces in images with their 68 landmarks: of iBUG's and dlib's files, or rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.color_space import grey_images
from torchface.errors import FileFormatError
from torchface.io import load_image, load_landmark_points
from torchface.io.images.image_files import IMAGE_ENDINGS
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.landmarks.images.ibug_68 import box_around
from torchface.progress import Progress, silent

from .rendered_people.portraits import FaceImage, FaceImageSettings, face_images
from .spawned_processes import map_in_processes

_MAX_BOX = 240.0  # pixels a side; larger faces are made smaller, as pairs of pixels say no more than this anyway
_PART = 60  # images that a process renders at once
_AROUND = 0.8  # of the box that is kept on every side
_MIRRORED = "_mirror"  # ends the names of iBUG's mirrored copies


@dataclass(frozen=True, eq=False)
class Faces:
    """Grey images uint8 (H,W), boxes (M,4) and landmarks (M,68,2) in their pixels, and whom each shows."""

    images: list[Tensor]
    boxes: Tensor
    landmarks: Tensor
    people: list[str]

    def __len__(self) -> int:
        return len(self.images)

    def some(self, rows: Sequence[int]) -> Faces:
        """The faces of these numbers."""
        images, people = ([of[row] for row in rows] for of in (self.images, self.people))
        return Faces(images, self.boxes[list(rows)], self.landmarks[list(rows)], people)  # type: ignore[arg-type]

    def __add__(self, other: Faces) -> Faces:
        return Faces(
            self.images + other.images,
            torch.cat([self.boxes, other.boxes]),
            torch.cat([self.landmarks, other.landmarks]),
            self.people + other.people,
        )


NO_FACES = Faces([], torch.zeros(0, 4), torch.zeros(0, 68, 2), [])


def annotated_landmarks(path: Path) -> list[tuple[Path, Tensor]]:
    """Pictures and their 68 landmarks (68,2), of a folder of ``.pts`` files or of a dlib ``.xml``."""
    found: list[tuple[Path, Tensor]] = []
    if path.suffix.lower() == ".xml":
        for face in load_dlib_faces(path):
            if face.points.shape == (68, 2) and bool(torch.isfinite(face.points).all()):
                found.append((_beside(path, face.image), face.points))
    elif path.is_dir():
        for file in sorted(path.rglob("[!.]*.pts")):  # not hidden files, as macOS leaves
            pictures = [file.with_suffix(ending) for ending in IMAGE_ENDINGS if file.with_suffix(ending).is_file()]
            if not pictures:
                raise FileFormatError(
                    f"{file}: found no image of the same name, expected one beside it, of {', '.join(IMAGE_ENDINGS)}"
                )
            found.append((pictures[0], load_landmark_points(file).ibug()))
    else:
        raise FileFormatError(f"{path}: found no folder and no .xml, expected iBUG's .pts files or dlib's XML")
    if not found:
        raise FileFormatError(f"{path}: found no face with 68 landmarks, expected at least one")
    return found


def load_faces(path: Path, folders_are_people: bool = False) -> Faces:
    """The annotated faces of a folder of ``.pts`` files or of a dlib ``.xml``; those without all 68 are left out.

    A mirrored copy shows the same person; so do all pictures of a folder, if ``folders_are_people``.
    """
    found = annotated_landmarks(path)
    known: dict[Path, Tensor] = {}
    faces = NO_FACES
    for picture, points in found:
        if picture not in known:
            known = {picture: grey_images(load_image(picture)[None])[0, 0]}  # faces of an image come in a row
        who = picture.parent if folders_are_people else picture.with_name(picture.stem.removesuffix(_MIRRORED))
        faces = faces + _cropped(known[picture], points.float(), str(who))
    return faces


def rendered_faces(
    count: int, seed: int, settings: FaceImageSettings | None = None, progress: Progress | None = None, workers: int = 1
) -> Faces:
    """Images of synthetic people; how many processes render them does not change them."""
    parts = [(seed, settings, start, min(_PART, count - start)) for start in range(0, count, _PART)]
    progress = progress or silent
    pictures: list[FaceImage] = []
    for part in map_in_processes(_rendered_part, parts, workers):
        pictures += part
        progress("rendering portraits", len(pictures), count)
    if not pictures:
        return NO_FACES
    return Faces(
        [picture.image for picture in pictures],
        torch.stack([picture.box for picture in pictures]),
        torch.stack([picture.landmarks for picture in pictures]),
        [f"performer {number}" for number in range(len(pictures))],
    )


def _rendered_part(part: tuple[int, FaceImageSettings | None, int, int]) -> list[FaceImage]:
    seed, settings, first, count = part
    return list(face_images(count, seed, settings, first=first))


def _beside(path: Path, name: str) -> Path:
    """An image that an XML names; one outside of its folder is refused."""
    picture = path.parent / name
    if not picture.resolve().is_relative_to(path.parent.resolve()):
        raise FileFormatError(f"{path}: found the image {name!r:.80}, expected one in the same folder")
    return picture


def _cropped(grey: Tensor, landmarks: Tensor, who: str) -> Faces:
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
    return Faces([stored], box_around(landmarks)[None], landmarks[None], [who])
