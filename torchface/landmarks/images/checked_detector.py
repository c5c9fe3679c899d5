"""Detector of faces whose boxes the landmark network checks: one that shows no face goes, the others fit better."""

import math
from functools import cache

import torch
from torch import Tensor

from torchface.files.model_roots import shipped_model
from torchface.files.models import read_model
from torchface.landmarks.images.boxes.box_network import BoxNetwork
from torchface.landmarks.images.boxes.face_box import FaceBoxes, FaceDetector, overlaps, sorted_boxes
from torchface.landmarks.images.boxes.network_detector import NetworkDetector
from torchface.landmarks.images.face_crop import crop_transform, cut_crop, from_crop
from torchface.landmarks.images.face_reading import confidence_of
from torchface.landmarks.images.folded_normalisation import without_normalisation
from torchface.landmarks.images.ibug_68 import turned_box
from torchface.landmarks.images.networks.crop_finder import CropFinder, CropNetwork
from torchface.landmarks.images.networks.landmark_network import LandmarkNetwork

PROPOSED = 0.3  # score from which the shipped box network's faces are looked at

_MOST, _TURNED = 16, 3  # faces of a detector that are looked at, the likeliest; and of them in other turns
_TURNS = ((0.0,), (math.pi / 3, -math.pi / 3, math.pi))  # beside the detector's tilt; the latter where no face is found
# Presence and mean confidence round the landmarks: of 155 boxes of faces 132 have both, of 319 in pictures without 1.
_PRESENCE, _CONFIDENCE = 0.8, 0.5
_DOUBTED = 0.18  # mean confidence in the detector's box from which it is worth a second look
_SMALLEST, _BESIDE, _SAME = 6.0, 0.2, 0.3  # pixels; overlaps from which a box is of the landmarks, and two of one face


class CheckedDetector:
    """Faces of a detector that a landmark network too takes for faces, in the boxes round their landmarks.

    Each box is looked at turned upright as the detector says, then once more round what was found.
    """

    def __init__(self, detector: FaceDetector, network: LandmarkNetwork | CropFinder) -> None:
        self.detector, self.size, self.margin = detector, network.size, network.margin
        self.network: CropNetwork = (
            network.network if isinstance(network, CropFinder) else without_normalisation(network).float()
        )

    @torch.inference_mode()
    def __call__(self, image: Tensor) -> FaceBoxes:
        found = self.detector(image)
        rows = found.scores.topk(min(_MOST, len(found))).indices
        for turns, most in zip(_TURNS, (_MOST, _TURNED), strict=True):
            boxes, tilts = found.boxes[rows[:most]], found.tilts[rows[:most]]
            faces = self._faces(image, boxes.repeat(len(turns), 1), torch.cat([tilts + turn for turn in turns]))
            if len(faces):
                break
        return faces

    def _faces(self, image: Tensor, boxes: Tensor, tilts: Tensor) -> FaceBoxes:
        """The faces that the network sees in boxes (F,4) turned by tilts (F,)."""
        presence = torch.zeros(len(boxes))
        for presence_asked, confidence_asked in (
            (0.0, _DOUBTED),
            (_PRESENCE, _CONFIDENCE),
        ):  # detectors' boxes fit loosely: once more round what was found
            large = boxes[:, 2] >= _SMALLEST
            boxes, tilts = boxes[large], tilts[large]
            if not len(boxes):
                return FaceBoxes(torch.zeros(0, 4), torch.zeros(0))
            landmarks, presence, confidence = self._look(image, boxes, tilts)
            around, turned = turned_box(landmarks)
            kept = (presence >= presence_asked) & (confidence >= confidence_asked)
            kept &= overlaps(around, boxes).diagonal() >= _BESIDE
            boxes, tilts, presence = around[kept], turned[kept], presence[kept]
        first = presence.argsort(descending=True, stable=True)
        boxes, tilts, presence = boxes[first], tilts[first], presence[first]
        known = (overlaps(boxes, boxes).tril(-1) >= _SAME).any(1)  # of a face that is found already
        return sorted_boxes(boxes[~known], presence[~known], tilts[~known])

    def _look(self, image: Tensor, boxes: Tensor, tilts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Landmarks (F,68,2), presence and mean confidence (F,) in boxes (F,4) that are turned by tilts (F,)."""
        size, margin = self.size, self.margin
        ways = [crop_transform(box, tilt, size, margin) for box, tilt in zip(boxes, tilts.tolist(), strict=True)]
        crops = torch.stack([cut_crop(image, way, size) for way in ways])  # of different scales: one by one
        seen = self.network(crops.float() / 255)
        places = [from_crop(marks, way) for marks, way in zip(seen.landmarks, ways, strict=True)]
        return torch.stack(places), seen.presence, confidence_of(seen.deviation * (margin / size)).mean(1)


@cache
def shipped_networks() -> tuple[BoxNetwork, LandmarkNetwork]:
    """The ``face_boxes`` and the ``landmark_network`` that come with this package; read once."""
    return (
        read_model(shipped_model("face_boxes"), {"face_boxes": BoxNetwork}),
        read_model(shipped_model("landmark_network"), {"landmark_network": LandmarkNetwork}),
    )


@cache
def shipped_detector() -> CheckedDetector:
    """The detector of :func:`shipped_networks`, which raises as that does."""
    boxes, landmarks = shipped_networks()
    return CheckedDetector(NetworkDetector(boxes, PROPOSED), landmarks)
