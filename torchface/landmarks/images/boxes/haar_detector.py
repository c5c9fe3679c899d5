"""OpenCV's shipped Haar cascades as a detector of upright faces, and the settings of each search with them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError, ValueRangeError
from torchface.landmarks.images.boxes.face_box import FaceBoxes, grey_pixels, overlaps, shrunk, sorted_boxes

PICTURE: dict[str, Any] = {"profiles": "always"}
"""Of a search of a single picture, beside the defaults of ``HaarDetector``."""
STREAM: dict[str, Any] = {"smallest": 0.1, "step": 1.15}
"""Of a search of a video's frame, quicker."""
SURROUNDINGS: dict[str, Any] = {"smallest": 0.33, "step": 1.1}
"""Of a look at twice the box of a face that is followed."""
TURNED: dict[str, Any] = {"profiles": "never"}
"""Of a search of a copy that was turned."""

_WINDOW = 24  # pixels a side of the smallest face that a cascade is shown
_FRONTAL = 0.25  # overlap with a frontal box from which one of a profile is of the same face
# A profile cascade's box beside the frontal one's for the same face: this much of a side further to where the face
# looks away from, and this much larger. Medians over photographs and drawn faces.
_PROFILE_ASIDE, _PROFILE_SIZE = 0.2, 1.25


@dataclass(frozen=True)
class HaarDetector:
    """OpenCV's shipped cascades: the frontal one, and that of profiles on the image and its mirror image.

    A box of a profile counts only where no frontal one overlaps it. The search works on a small copy of the image, in
    which the smallest face looked for has 24 pixels, so that large images cost no more than small ones.

    Args:
        smallest: side of the smallest face's box, of the image's shorter side.
        neighbours: search windows that must agree on a face.
        step: factor between the sizes searched.
        profiles: also look for profiles where no frontal face is found at all; ``"always"`` in every image,
            ``"never"`` in none.

    Source: Viola and Jones 2001; Lienhart and Maydt 2002.

    Example:
        >>> frontal = HaarDetector(profiles="never", neighbours=5)
        >>> len(frontal(torch.full((120, 160), 128, dtype=torch.uint8)).boxes)
        0
    """

    smallest: float = 1 / 12
    neighbours: int = 3
    step: float = 1.1
    profiles: str = "alone"
    _cascades: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (0 < self.smallest <= 1 and self.neighbours >= 1 and 1 < self.step <= 2):
            raise ValueRangeError(
                f"HaarDetector: found smallest {self.smallest}, neighbours {self.neighbours}, step {self.step}; "
                "expected a share in (0,1], at least 1, and a factor in (1,2]"
            )
        if self.profiles not in ("alone", "always", "never"):
            raise ValueRangeError(f"profiles: found {self.profiles!r}, expected alone, always or never")

    def __call__(self, image: Tensor) -> FaceBoxes:
        grey = grey_pixels(image)
        scale = min(1.0, _WINDOW / max(self.smallest * min(grey.shape), 1e-6))
        if min(grey.shape) * scale < _WINDOW:
            return sorted_boxes(torch.zeros(0, 4), torch.zeros(0))
        small = shrunk(np.ascontiguousarray(grey), scale)
        boxes, counts = self._search("haarcascade_frontalface_alt2.xml", small)
        if self.profiles == "always" or (self.profiles == "alone" and not len(boxes)):
            for mirrored in (False, True):
                searched = np.ascontiguousarray(small[:, ::-1]) if mirrored else small
                aside, agreed = self._search("haarcascade_profileface.xml", searched)
                aside = _as_frontal(aside)
                if mirrored:
                    aside[:, 0] = small.shape[1] - 1 - aside[:, 0] - aside[:, 2]
                free = overlaps(aside, boxes).amax(1) < _FRONTAL if len(boxes) else torch.ones(len(aside)).bool()
                boxes, counts = torch.cat([boxes, aside[free]]), torch.cat([counts, agreed[free]])
        if len(boxes):  # back to the image's pixels, whose centres are at integers
            ratio = boxes.new_tensor([grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0]])
            boxes = torch.cat([(boxes[:, :2] + 0.5) * ratio - 0.5, boxes[:, 2:] * ratio], 1)
        return sorted_boxes(boxes, counts / (counts + 10))

    def _search(self, name: str, grey: np.ndarray) -> tuple[Tensor, Tensor]:
        """Boxes (F,4) and how many windows agreed on each (F,)."""
        if name not in self._cascades:
            self._cascades[name] = _cascade(name)
        boxes, counts = self._cascades[name].detectMultiScale2(
            grey, scaleFactor=self.step, minNeighbors=self.neighbours, minSize=(_WINDOW, _WINDOW)
        )
        return (
            torch.from_numpy(np.asarray(boxes, dtype=np.float32).reshape(-1, 4)),
            torch.from_numpy(np.asarray(counts, dtype=np.float32).reshape(-1)),
        )


def _as_frontal(boxes: Tensor) -> Tensor:
    """Boxes (F,4) of faces that look to the left, as the frontal cascade would draw them."""
    side = boxes[:, 2:] / _PROFILE_SIZE
    middle = boxes[:, :2] + boxes[:, 2:] / 2
    middle = middle - side * side.new_tensor([_PROFILE_ASIDE, 0.0])
    return torch.cat([middle - side / 2, side], 1)


def _cascade(name: str) -> Any:
    folder = Path(getattr(getattr(cv2, "data", None), "haarcascades", ""))
    cascade = cv2.CascadeClassifier(str(folder / name))
    if cascade.empty():
        raise FileFormatError(f"{folder / name}: cannot be read; expected OpenCV 4 with the cascades that it ships")
    return cascade
