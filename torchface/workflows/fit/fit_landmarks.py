"""Landmarks of photographs: given by files, or found and remarked on."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.files.whole_files import read_file
from torchface.io import load_image, load_landmark_points
from torchface.io.images.image_headers import read_header
from torchface.io.landmarks.dlib_xml import LabelledFace, load_dlib_faces
from torchface.io.landmarks.landmark_tables import load_landmark_table
from torchface.landmarks import FaceReading, NoFaceError, find_faces, find_landmarks
from torchface.landmarks.images.face_mesh_478 import landmarks_of_mesh
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.modeling.photographs.landmark_view import LANDMARKS
from torchface.workflows.named_finders import DEFAULT_LANDMARKS, load_finder


def landmarks_of(photographs: Sequence[Path], files: Sequence[Path], face: int | None = None) -> list[Tensor]:
    """The landmarks (68,2) of each photograph: a file each, or one of dlib's XML that names them, or a table, a row
    each.

    ``face`` is which of several in an XML, as they are detected, the largest first, then those that are not.
    """
    if not photographs:
        raise NameMismatchError("fit: found no photograph, expected one at least")
    if len(files) == 1 and files[0].suffix.lower() == ".xml":
        return [_face_in(files[0], path, face) for path in photographs]
    if len(files) == 1 and files[0].suffix.lower() == ".csv":
        return _rows_of(files[0], photographs)
    if len(files) != len(photographs):
        raise NameMismatchError(
            f"landmarks: found {len(files)} files for {len(photographs)} photographs, expected one each, or one .xml"
        )
    return [
        _face_in(file, photograph, face) if file.suffix.lower() == ".xml" else _pixels(file)
        for file, photograph in zip(files, photographs, strict=True)
    ]


def is_landmark_file(path: Path) -> bool:
    """Whether a path is one of landmarks, rather than the name of what finds them."""
    return path.suffix.lower() in (".pts", ".ljson", ".json", ".xml", ".csv")


def _rows_of(table: Path, photographs: Sequence[Path]) -> list[Tensor]:
    """A row of a table for each photograph."""
    marks = load_landmark_table(table)
    if len(marks.points) != len(photographs):
        raise NameMismatchError(
            f"{table}: found landmarks of {len(marks.points)} photographs, expected the {len(photographs)} given"
        )
    rows = []
    for i, photograph in enumerate(photographs):  # a photograph at a time: they differ in size
        height, width = load_image(photograph).shape[-2:]
        points = marks.pixels(width, height)[i].double()
        rows.append(points if len(points) == COUNT else landmarks_of_mesh(points))
    return rows


def check_inside(photographs: Sequence[Path], landmarks: Tensor, sizes: Sequence[tuple[int, int]]) -> None:
    """Refuses landmarks (P,68,2) of which most lie outside their photograph, as those counted before it was turned
    upright."""
    for photograph, points, (width, height) in zip(photographs, landmarks, sizes, strict=True):  # sizes differ
        points = points[points.isfinite().all(-1)]
        inside = (points >= -0.5).all(-1) & (points < points.new_tensor([width, height]) - 0.5).all(-1)
        if len(points) and float(inside.double().mean()) < 0.5:
            raise ValueRangeError(
                f"{photograph}: found {int((~inside).sum())} of {len(points)} landmarks outside its {width} x {height} "
                "pixels, expected those of this photograph, counted upright, as viewers show it"
            )


def warn_if_stored_turned(photograph: Path) -> None:
    """Warns of a photograph whose given landmarks may count other pixels than are fitted: its EXIF turns it upright."""
    header = read_header(read_file(photograph), str(photograph))
    if header is not None and header.orientation != 1:
        warnings.warn(
            f"{photograph}: found a photograph that its camera stored turned (EXIF orientation {header.orientation}); "
            "its landmarks are taken to count upright pixels, as viewers show it, and not stored ones, as dlib's do",
            stacklevel=2,
        )


def _pixels(file: Path) -> Tensor:
    points = load_landmark_points(file).ibug()
    if points.shape[1] != 2:
        raise FileFormatError(f"{file}: found points in space, three numbers each; expected pixels of a photograph")
    return points.double()


def _face_in(file: Path, photograph: Path, face: int | None) -> Tensor:
    faces = [one for one in load_dlib_faces(file) if Path(one.image.replace("\\", "/")).name == photograph.name]
    if not faces:
        raise NameMismatchError(f"{file}: found no face in {photograph.name}, expected one")
    if len(faces) > 1:
        faces = _as_detected(faces, photograph)
    if face is None and len(faces) > 1:
        places = ", ".join(f"{k}: at ({int(one.box[0])}, {int(one.box[1])})" for k, one in enumerate(faces[:20]))
        raise NameMismatchError(f"{file}: found {len(faces)} faces in {photograph.name}, choose one of --face {places}")
    number = face or 0
    if not 0 <= number < len(faces):
        raise NameMismatchError(f"{file}: found {len(faces)} faces in {photograph.name}, expected more than {number}")
    points = faces[number].points
    if points.shape != (LANDMARKS, 2):
        raise ShapeError(f"{file}: found {len(points)} landmarks in {photograph.name}, expected {LANDMARKS}")
    return points


def _as_detected(faces: list[LabelledFace], photograph: Path) -> list[LabelledFace]:
    """Faces in the order in which ``find_in_photographs`` numbers them."""
    boxes = find_faces((load_image(photograph)[:3].clamp(0, 1) * 255).round().to(torch.uint8)).boxes.double()
    middle = torch.stack([face.box[:2] + face.box[2:] / 2 for face in faces]).double()
    inside = (middle[:, None] >= boxes[None, :, :2]) & (middle[:, None] <= boxes[None, :, :2] + boxes[None, :, 2:])
    numbers = torch.where(inside.all(-1), torch.arange(len(boxes)), len(boxes))
    rank = torch.cat([numbers, torch.full((len(faces), 1), len(boxes))], dim=1).amin(1).tolist()
    size = torch.stack([face.box[2:].prod() for face in faces]).tolist()
    return [faces[k] for k in sorted(range(len(faces)), key=lambda k: (rank[k], -size[k]))]


UNSURE = 0.2
"""Landmarks of lower confidence are left out of a fit."""

_HIDDEN, _EYES_HIDDEN = 0.3, 0.3  # visibilities
_MIN_CONFIDENT = 25
_PARTS = {"jaw": slice(0, 17), "brows": slice(17, 27), "nose": slice(27, 36), "eyes": slice(36, 48)} | {
    "mouth": slice(48, 68)
}


@dataclass(frozen=True, eq=False)
class PhotographLandmarks:
    """What was found in one photograph."""

    photograph: Path
    model: str
    face: FaceReading
    number: int  # which of the faces it is, from 0, the largest first
    boxes: Tensor  # of all faces, x, y, width, height, (F,4) pixels
    size: tuple[int, int]  # of the photograph, width and height
    asked: bool = False  # whether the user said which face
    # of the points that the model finds beside the 68, on the embedded performer's sculpture, (P,3) mm
    places: Tensor = field(default_factory=lambda: torch.zeros(0, 3))

    @property
    def confident(self) -> Tensor:
        """The landmarks (68,2) float64, NaN where they are unsure, hidden or outside the image.

        All are kept where most are unsure: then there is nothing better.
        """
        points = self.face.landmarks.double()
        unsure = (self.face.confidence < UNSURE) | (self.face.visibility < _HIDDEN)
        unsure[36:48] |= bool(self.face.iris.isfinite().any() and self.face.eye_visibility.mean() < _EYES_HIDDEN)
        if int((~unsure).sum()) < _MIN_CONFIDENT:
            unsure = torch.zeros_like(unsure)
        outside = ((points < -0.5) | (points > points.new_tensor(self.size) - 0.5)).any(1)
        return torch.where((unsure | outside)[:, None], torch.nan, points)

    def lines(self) -> list[str]:
        """For people to read."""
        box, confidence = self.face.box.round().int().tolist(), self.face.confidence
        weakest = min(_PARTS, key=lambda part: float(confidence[_PARTS[part]].mean()))
        unsure = int(self.confident.isnan().any(1).sum())
        lines = [
            f"{self.photograph.name}: landmarks found by {self.model} in the face at ({box[0]}, {box[1]}), {box[2]} "
            f"pixels wide; confidence {float(confidence.mean()):.2f}, lowest at the {weakest} with "
            f"{float(confidence[_PARTS[weakest]].mean()):.2f}" + (f"; {unsure} left out" if unsure else "")
        ]
        if len(self.boxes) > 1:
            others = ", ".join(
                f"{k}: at ({round(float(one[0]))}, {round(float(one[1]))})"
                for k, one in enumerate(self.boxes[:20])
                if k != self.number
            )
            which = "the largest" if self.number == 0 else f"number {self.number}"
            lines.append(f"  {which} of {len(self.boxes)} faces; others with --face {others}")
        return lines


def find_in_photographs(
    photographs: Sequence[Path],
    images: Sequence[Tensor],
    model: str | Path = DEFAULT_LANDMARKS,
    face: int | None = None,
) -> list[PhotographLandmarks]:
    """Finds one face in each photograph (3,H,W), the largest, or which of them by number, the largest first."""
    named = load_finder(model, shown="photograph", option="landmark model")
    finder = named.finder
    readings = []
    for path, image in zip(photographs, images, strict=True):  # one photograph at a time: they differ in size
        pixels = (image[:3].clamp(0, 1) * 255).round().to(torch.uint8)
        faces = find_faces(pixels)
        try:
            reading = find_landmarks(pixels, finder, face or 0, lambda _, faces=faces: faces)  # type: ignore[misc]
        except NoFaceError as error:
            raise NoFaceError(
                f"{path}: {str(error).partition(': ')[2]}; give another photograph, or landmarks with --landmarks"
            ) from error
        size = (pixels.shape[2], pixels.shape[1])
        asked, number = face is not None, face or 0
        readings.append(PhotographLandmarks(path, str(model), reading, number, faces.boxes, size, asked, named.places))
    return readings
