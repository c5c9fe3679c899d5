"""Where faces are in an image: OpenCV's shipped Haar cascades, or a YuNet network that the user brings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError, TorchfaceError, ValueRangeError

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what matters comes as an error

_WINDOW = 24  # pixels a side of the smallest face that a cascade is shown
_OVERLAP = 0.25
# A profile cascade's box beside the frontal one's for the same face: this much of a side further to where the face
# looks away from, and this much larger. Medians over photographs and drawn faces.
_PROFILE_ASIDE, _PROFILE_SIZE = 0.2, 1.25
_MAX_NETWORK = 64 * 2**20
_NETWORK_OUTPUTS = tuple(f"{name}_{stride}" for name in ("cls", "obj", "bbox", "kps") for stride in (8, 16, 32))
# Eyes, tip of the nose, corners of the mouth in a face's box, over photographs and drawn faces.
_FIVE = torch.tensor([[0.33, 0.374], [0.68, 0.374], [0.49, 0.572], [0.357, 0.758], [0.655, 0.758]])


class NoFaceError(TorchfaceError):
    """An image shows no face, or fewer than asked for.

    Example:
        >>> find_face(torch.full((120, 160), 128, dtype=torch.uint8))
        Traceback (most recent call last):
            ...
        torchface.landmarks.images.boxes.face_box.NoFaceError: image of 160 x 120: found no face, expected one at least
    """


@dataclass(frozen=True, eq=False)
class FaceBoxes:
    """Faces found in an image, the largest first.

    Args:
        boxes: x, y, width, height, (F,4) float32 pixels; squares as ``ibug.box_around`` draws them.
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
        small = np.ascontiguousarray(grey)
        if scale < 1:
            small = _shrunk(small, scale)
        boxes, counts = self._search("haarcascade_frontalface_alt2.xml", small)
        if self.profiles == "always" or (self.profiles == "alone" and not len(boxes)):
            for mirrored in (False, True):
                seen = np.ascontiguousarray(small[:, ::-1]) if mirrored else small
                aside, found = self._search("haarcascade_profileface.xml", seen)
                aside = _as_frontal(aside)
                if mirrored:
                    aside[:, 0] = small.shape[1] - 1 - aside[:, 0] - aside[:, 2]
                free = overlaps(aside, boxes).amax(1) < _OVERLAP if len(boxes) else torch.ones(len(aside)).bool()
                boxes, counts = torch.cat([boxes, aside[free]]), torch.cat([counts, found[free]])
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


class YuNetDetector:
    """The YuNet network, from an ONNX file that the user names (``face_detection_yunet_2023mar.onnx`` of OpenCV's zoo).

    Boxes are drawn round the five points that it finds, as the cascade would draw them.

    Args:
        path: the file.
        least_score: faces of lower score are none.
        longest: the image is made smaller until its longer side has so many pixels.

    Raises:
        FileFormatError: the file cannot be read or is no such network.

    Source: Wu, Peng, Yu 2023.
    """

    def __init__(self, path: str | Path, least_score: float = 0.7, longest: int = 640) -> None:
        if not (0 < least_score < 1 and longest >= 32):
            raise ValueRangeError(
                f"YuNetDetector: found score {least_score}, longest {longest}; expected (0,1), from 32"
            )
        self.path, self.least_score, self.longest = Path(path), least_score, longest
        _check_network(self.path)
        try:
            self._network = cv2.FaceDetectorYN.create(str(self.path), "", (longest, longest), least_score, 0.3, 1000)
        except cv2.error as error:
            raise self._broken(error) from error

    def __call__(self, image: Tensor) -> FaceBoxes:
        pixels = image if image.ndim == 3 else image.expand(3, *image.shape[-2:])
        check_image(pixels)
        colors = np.ascontiguousarray(pixels.flip(0).permute(1, 2, 0).cpu().numpy())
        height, width = colors.shape[:2]
        scale = min(1.0, self.longest / max(height, width))
        small = _shrunk(colors, scale) if scale < 1 else colors
        try:
            self._network.setInputSize((small.shape[1], small.shape[0]))
            found = self._network.detect(small)[1]
        except cv2.error as error:
            raise self._broken(error) from error
        rows = torch.zeros(0, 15) if found is None else torch.from_numpy(np.asarray(found, dtype=np.float32))
        if rows.shape[1:] != (15,):
            raise FileFormatError(f"{self.path}: found {tuple(rows.shape)} from the network, expected (F,15)")
        rows = rows[torch.isfinite(rows).all(1)]
        ratio = rows.new_tensor([width / small.shape[1], height / small.shape[0]])
        points = (rows[:, 4:14].view(-1, 5, 2) + 0.5) * ratio - 0.5
        return sorted_boxes(_box_of_five(points), rows[:, 14].clamp(0, 1))

    def _broken(self, error: Exception) -> FileFormatError:
        return FileFormatError(
            f"{self.path}: cannot be used as a YuNet network ({' '.join(str(error).split())[:120]}); expected "
            "face_detection_yunet_2023mar.onnx or one like it"
        )


def find_faces(image: Tensor, detector: FaceDetector | None = None) -> FaceBoxes:
    """All faces in an image, the largest first; none is no error.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        detector: the shipped cascades if absent, profiles beside frontal faces.

    Raises:
        ShapeError: no such image.

    Example:
        >>> len(find_faces(torch.full((120, 160), 128, dtype=torch.uint8)).boxes)
        0
    """
    check_image(image)
    return (detector or HaarDetector(profiles="always"))(image)


def find_face(image: Tensor, number: int = 0, detector: FaceDetector | None = None) -> Tensor:
    """The box of one face: x, y, width, height, (4,) pixels; see :func:`find_some_faces`.

    Example:
        >>> from torchface.landmarks import NoFaceError
        >>> try:
        ...     box = find_face(torch.full((120, 160), 128, dtype=torch.uint8))
        ... except NoFaceError as error:
        ...     print(error)
        image of 160 x 120: found no face, expected one at least
    """
    return find_some_faces(image, number, detector).boxes[number]


def find_some_faces(image: Tensor, number: int = 0, detector: FaceDetector | None = None) -> FaceBoxes:
    """All faces in an image, the largest first, one of this number among them.

    Args:
        image: uint8 (H,W), or (3,H,W) red first.
        number: of the face that must be there, from 0.
        detector: the shipped cascades if absent.

    Raises:
        NoFaceError: there are not so many.
        ShapeError: no such image.
    """
    faces = find_faces(image, detector)
    if not 0 <= number < len(faces):
        found = "no face" if not len(faces) else f"{len(faces)} {'face' if len(faces) == 1 else 'faces'}"
        raise NoFaceError(
            f"image of {image.shape[-1]} x {image.shape[-2]}: found {found}, expected "
            + ("one at least" if number == 0 else f"more than {number}")
        )
    return faces


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
    return cv2.cvtColor(np.ascontiguousarray(image.permute(1, 2, 0).cpu().numpy()), cv2.COLOR_RGB2GRAY)


def sorted_boxes(boxes: Tensor, scores: Tensor, tilts: Tensor | None = None) -> FaceBoxes:
    """Boxes (F,4), scores (F,) and tilts (F,), the largest face first."""
    order = (boxes[:, 2] * boxes[:, 3]).argsort(descending=True, stable=True)
    return FaceBoxes(boxes[order], scores[order], None if tilts is None else tilts[order])  # type: ignore[arg-type]


def check_image(image: Tensor) -> None:
    """Raises a ``ShapeError`` where an image is not uint8 (H,W) or (3,H,W)."""
    if image.dtype != torch.uint8 or not (image.ndim == 2 or (image.ndim == 3 and len(image) == 3)) or 0 in image.shape:
        raise ShapeError(f"image: found {image.dtype} {tuple(image.shape)}, expected uint8 (H,W) or (3,H,W)")


def _as_frontal(boxes: Tensor) -> Tensor:
    """Boxes (F,4) of faces that look to the left, as the frontal cascade would draw them."""
    side = boxes[:, 2:] / _PROFILE_SIZE
    middle = boxes[:, :2] + boxes[:, 2:] / 2
    middle = middle - side * side.new_tensor([_PROFILE_ASIDE, 0.0])
    return torch.cat([middle - side / 2, side], 1)


def _box_of_five(points: Tensor) -> Tensor:
    """Boxes (F,4) round eyes, nose and corners of the mouth (F,5,2)."""
    mean = _FIVE.mean(0)
    spread = (points - points.mean(1, keepdim=True)).square().sum((1, 2)).sqrt()
    side = spread / (_FIVE - mean).square().sum().sqrt()
    corner = points.mean(1) - side[:, None] * mean
    return torch.cat([corner, side[:, None].expand(-1, 2)], 1)


def _shrunk(pixels: np.ndarray, scale: float) -> np.ndarray:
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def _cascade(name: str) -> Any:
    folder = Path(getattr(getattr(cv2, "data", None), "haarcascades", ""))
    cascade = cv2.CascadeClassifier(str(folder / name))
    if cascade.empty():
        raise FileFormatError(f"{folder / name}: cannot be read; expected OpenCV 4 with the cascades that it ships")
    return cascade


def _check_network(path: Path) -> None:
    """Looks at the file before OpenCV does: its size, whether it is ONNX, and whether its outputs are YuNet's."""
    import onnx

    try:
        size = path.stat().st_size
        content = path.read_bytes() if 0 < size <= _MAX_NETWORK else b""
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path}: cannot be read ({error})") from error
    if not content:
        raise FileFormatError(f"{path}: found {size} bytes, expected a YuNet network of 1 to {_MAX_NETWORK}")
    try:
        model = onnx.load_model_from_string(content)
        onnx.checker.check_model(model)
    except Exception as error:  # protobuf and the checker raise what they like
        raise FileFormatError(f"{path}: found no valid ONNX file, expected a YuNet network") from error
    outputs = {output.name for output in model.graph.output}
    missing = [name for name in _NETWORK_OUTPUTS if name not in outputs]
    if missing:
        raise FileFormatError(
            f"{path}: found outputs {', '.join(sorted(outputs))[:80] or 'none'}, expected a YuNet network's "
            f"({', '.join(missing[:4])}, ...)"
        )
