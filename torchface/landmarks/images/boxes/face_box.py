"""Boxes of faces in an image: the record, the protocol of detectors, and what all detectors share."""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError, TorchfaceError

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what matters comes as an error


class NoFaceError(TorchfaceError):
    """An image shows no face, or fewer than asked for.

    Example:
        >>> from torchface.landmarks.images.find_faces import find_some_faces
        >>> find_some_faces(torch.full((120, 160), 128, dtype=torch.uint8))
        Traceback (most recent call last):
            ...
        torchface.landmarks.images.boxes.face_box.NoFaceError: image of 160 x 120: found no face, expected one at least
    """


@dataclass(frozen=True, eq=False)
class FaceBoxes:
    """Faces found in an image, the largest first.

    Args:
        boxes: x, y, width, height, (F,4) float32 pixels; squares as ``ibug_68.box_around`` draws them.
        scores: how sure the detector is, (F,) in [0,1].
        tilts: how far each face is turned in the image, (F,) radians, clockwise as it is seen; zeros if absent, as of
            a detector that finds upright faces alone.

    Example:
        >>> faces = FaceBoxes(torch.tensor([[10.0, 20.0, 60.0, 60.0]]), torch.tensor([0.9]))
        >>> faces.tilts.tolist()  # upright
        [0.0]
    """

    boxes: Tensor
    scores: Tensor
    tilts: Tensor = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.tilts is None:
            object.__setattr__(self, "tilts", torch.zeros(len(self.boxes)))

    def __len__(self) -> int:
        return len(self.boxes)


class FaceDetector(Protocol):
    """Finds faces in one image, uint8 (H,W) or (3,H,W), red first."""

    def __call__(self, image: Tensor) -> FaceBoxes: ...


def overlaps(first: Tensor, second: Tensor) -> Tensor:
    """Intersection over union of boxes (F,4) and (G,4): (F,G)."""
    a, b = first[:, None], second[None]
    low = torch.maximum(a[..., :2], b[..., :2])
    high = torch.minimum(a[..., :2] + a[..., 2:], b[..., :2] + b[..., 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    return shared / (a[..., 2:].prod(-1) + b[..., 2:].prod(-1) - shared).clamp(min=1e-12)


def grey_pixels(image: Tensor) -> np.ndarray:
    """An image's grey values, uint8 (H,W), as OpenCV weighs colours."""
    check_image(image)
    if image.ndim == 2:
        return image.cpu().numpy()
    return cv2.cvtColor(interleaved(image), cv2.COLOR_RGB2GRAY)


def interleaved(image: Tensor) -> np.ndarray:
    """An image's values, uint8 (H,W) or (H,W,3), a pixel's side by side; a view where they lie so, as videos' do."""
    pixels = image.cpu()
    if image.ndim == 2:
        return pixels.numpy()
    beside = pixels.stride()[0::2] == (1, 3)
    return pixels.permute(1, 2, 0).numpy() if beside else cv2.merge([plane.numpy() for plane in pixels])


def at_most(image: Tensor, longest: int) -> tuple[Tensor, float]:
    """An image, uint8 (H,W) or (3,H,W), made smaller until its longer side has so many pixels; and its pixels a pixel
    of that."""
    ratio = max(image.shape[-2:]) / longest
    if ratio <= 1:
        return image, 1.0
    height, width = (max(1, round(side / ratio)) for side in image.shape[-2:])
    pixels = interleaved(image)
    while min(pixels.shape[0] / height, pixels.shape[1] / width) >= 2:  # three times as quick as shares of pixels
        pixels = cv2.resize(pixels, (pixels.shape[1] // 2, pixels.shape[0] // 2), interpolation=cv2.INTER_AREA)
    small = torch.from_numpy(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA))
    return small if image.ndim == 2 else small.permute(2, 0, 1), ratio


def sorted_boxes(boxes: Tensor, scores: Tensor, tilts: Tensor | None = None) -> FaceBoxes:
    """Boxes (F,4), scores (F,) and tilts (F,), the largest face first."""
    order = (boxes[:, 2] * boxes[:, 3]).argsort(descending=True, stable=True)
    return FaceBoxes(boxes[order], scores[order], None if tilts is None else tilts[order])  # type: ignore[arg-type]


def check_image(image: Tensor) -> None:
    """Raises a ``ShapeError`` where an image is not uint8 (H,W) or (3,H,W)."""
    if image.dtype != torch.uint8 or not (image.ndim == 2 or (image.ndim == 3 and len(image) == 3)) or 0 in image.shape:
        raise ShapeError(f"image: found {image.dtype} {tuple(image.shape)}, expected uint8 (H,W) or (3,H,W)")
