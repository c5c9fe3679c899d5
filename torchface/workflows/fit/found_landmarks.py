"""Landmarks of photographs that nobody has annotated, and remarks on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.landmarks import FaceReading, NoFaceError, find_landmarks
from torchface.landmarks.images.boxes.find_faces import find_faces_of_any_turn
from torchface.workflows.named_finders import DEFAULT_LANDMARKS, load_finder

UNSURE = 0.2
"""Landmarks of lower confidence are left out of a fit."""

_MIN_CONFIDENT = 40
_PARTS = {"jaw": slice(0, 17), "brows": slice(17, 27), "nose": slice(27, 36), "eyes": slice(36, 48)} | {
    "mouth": slice(48, 68)
}


@dataclass(frozen=True, eq=False)
class PhotographLandmarks:
    """What was found in one photograph.

    Args:
        photograph: the file.
        model: what found it.
        face: landmarks, box, confidence.
        number: which of the faces it is, from 0, the largest first.
        boxes: of all faces, x, y, width, height, (F,4) pixels.
        size: of the photograph, width and height.
    """

    photograph: Path
    model: str
    face: FaceReading
    number: int
    boxes: Tensor
    size: tuple[int, int]

    @property
    def confident(self) -> Tensor:
        """The landmarks (68,2) float64, NaN where they are unsure or outside the image.

        All are kept where most are unsure: then there is nothing better.
        """
        points = self.face.landmarks.double()
        unsure = self.face.confidence < UNSURE
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
    """Finds one face in each photograph.

    Args:
        photographs: the files, for what is said.
        images: they, (3,H,W) in [0,1].
        model: of landmarks, by name or folder.
        face: which one of each, from 0, the largest first; the largest if absent.

    Raises:
        NoFaceError: a photograph shows no face, or not so many.
        NameMismatchError: the model is of another kind.
    """
    finder = load_finder(model, photographs=True, option="landmark model").finder
    found = []
    for path, image in zip(photographs, images, strict=True):  # one photograph at a time: they differ in size
        pixels = (image[:3].clamp(0, 1) * 255).round().to(torch.uint8)
        faces = find_faces_of_any_turn(pixels)
        try:
            seen = find_landmarks(pixels, finder, face or 0, lambda _, faces=faces: faces)  # type: ignore[misc]
        except NoFaceError as error:
            raise NoFaceError(
                f"{path}: {str(error).partition(': ')[2]}; give another photograph, or landmarks with --landmarks"
            ) from error
        size = (pixels.shape[2], pixels.shape[1])
        found.append(PhotographLandmarks(path, str(model), seen, face or 0, faces.boxes, size))
    return found
