"""Landmarks by regression trees from several starts, and what their agreement says of the face."""

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.landmarks.images.boxes.face_box import grey_pixels
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.trees.landmark_consensus import REACH, Consensus, ConsensusSettings, consensus
from torchface.landmarks.images.trees.landmark_trees import LandmarkTrees

PHOTOGRAPH = ConsensusSettings(starts=48)  # starts for a single picture, where time matters less than in a video

_EVEN, _STEEPNESS = 0.054, 12.0
_AROUND = 0.06  # of the box's side: the patch round a landmark that must show something
_FLAT, _TEXTURED = 0.01, 0.03  # spread of a patch's grey values, of the picture's, of nothing and of skin


@dataclass(frozen=True, eq=False)
class TreeFinder:
    r"""Finds landmarks by trees: the robust mean over several starts.

    Starts on a face end near each other, starts on anything else do not: with the shipped trees the mean dispersion d
    was 0.008 to 0.036 of the box's side on 19 photographed faces, 0.004 to 0.020 on drawn ones, and 0.057 to 0.10 on
    pieces of images without a face (5th to 95th percentile; the most on a photographed face was 0.045, the least
    without one 0.054). The presence is :math:`1 / (1 + (d/0.054)^{12})`: 0.9 at 0.045, 0.1 at 0.065. Trees do not know
    what stands before a face: a landmark counts as hidden, and nothing is sure of it, where the picture is flat.

    Args:
        trees: find iBUG's 68 in a box.
        starts: from where they start.

    Raises:
        ValueRangeError: they find other landmarks than the 68.

    Example:
        >>> from torchface import zoo
        >>> blank = torch.full((80, 80), 128, dtype=torch.uint8)
        >>> face = TreeFinder(zoo.get_model("face_landmarks"))(blank, torch.tensor([10.0, 10.0, 60.0, 60.0]))
        >>> face.confidence.max().item()  # there is no face, and it is sure of nothing
        0.0
    """

    trees: LandmarkTrees
    starts: ConsensusSettings = field(default_factory=ConsensusSettings)
    name: str = "landmark trees"

    def __post_init__(self) -> None:
        if self.trees.mean.shape != (COUNT, 2):
            raise ValueRangeError(
                f"trees: found a model of {len(self.trees.mean)} landmarks, expected the {COUNT} of iBUG"
            )

    @torch.no_grad()
    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        """See :class:`~torchface.landmarks.images.landmark_finder.LandmarkFinder`."""
        corner, piece = _piece(image, box)
        grey = grey_pixels(piece)
        agreed = consensus(self.trees, torch.from_numpy(grey), box - corner, tilt, self.starts)
        visibility = _visibility(grey, agreed.landmarks, float((box[2] * box[3]).sqrt()))
        landmarks = agreed.landmarks.float() + corner[:2].to(agreed.landmarks).float()
        confidence = agreed.confidence.float() * visibility
        return FaceReading.of_confidence(
            landmarks, confidence, visibility, torch.tensor(presence_of(agreed)), box.float()
        )


def presence_of(agreed: Consensus) -> float:
    """How likely a consensus is one on a face."""
    return float(1 / (1 + (agreed.dispersion.mean() / _EVEN) ** _STEEPNESS))


def _visibility(grey: np.ndarray, landmarks: Tensor, side: float) -> Tensor:
    """Nothing (68,) where a picture is flat round a landmark, as it is under black or blown-out parts: there is nothing
    to see, whatever the trees say."""
    window = max(3, round(_AROUND * side) | 1)
    values = grey.astype(np.float32)
    mean, square = (cv2.blur(one, (window, window)) for one in (values, values * values))
    spread = torch.from_numpy(np.sqrt(np.maximum(square - mean * mean, 0)))
    height, width = spread.shape
    x = landmarks[:, 0].round().long().clamp(0, width - 1)
    y = landmarks[:, 1].round().long().clamp(0, height - 1)
    return ((spread[y, x] / max(float(values.std()), 1e-6) - _FLAT) / (_TEXTURED - _FLAT)).clamp(0, 1)


def _piece(image: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """The corner x, y, 0, 0 (4,) and the part of an image that the trees are shown, so that no more is made grey."""
    height, width = image.shape[-2:]
    if image.ndim not in (2, 3) or 0 in image.shape or box.shape != (4,) or not bool(torch.isfinite(box).all()):
        return torch.zeros(4), image  # the checks further on say what is wrong
    middle, reach = box[:2] + box[2:] / 2, REACH * float((box[2] * box[3]).clamp(min=0).sqrt()) + 2
    left, top = ((middle - reach).floor().clamp(min=0)).tolist()
    right, bottom = ((middle + reach).ceil() + 1).tolist()
    left, top = int(min(left, width - 1)), int(min(top, height - 1))
    right, bottom = int(min(max(right, left + 1), width)), int(min(max(bottom, top + 1), height))
    return box.new_tensor([left, top, 0, 0]), image[..., top:bottom, left:right]
