"""Lids, irises and what else is read off the eyes of a face whose landmarks are known."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.networks.eye_crop import cut_eyes, eye_transforms, moved, picture_transforms
from torchface.landmarks.images.networks.eye_merge import merged_lids
from torchface.landmarks.images.networks.eye_network import EyeFindings

LEAST = 6.0
"""Pixels of the image that a crop must be wide."""


@dataclass(frozen=True, eq=False)
class EyeFinder:
    """Reads the eyes of a face in an image.

    Args:
        network: from crops (2,3,h,w) float32 in [0,1], red first, to what they show.
        width, height: pixels of the crops.
    """

    network: Callable[[Tensor], EyeFindings]
    width: int
    height: int

    @torch.no_grad()
    def __call__(self, image: Tensor, face: FaceReading) -> FaceReading:
        """The face with its eyes, and landmarks 36 to 47 where both networks together put them.

        A face that is not there, or too small for its eyes to be seen, comes back as it is.

        Args:
            image: uint8 (H,W), or (3,H,W) red first.
            face: landmarks, deviation, visibility and presence are read.

        Raises:
            ShapeError: no such image.
        """
        transforms = eye_transforms(face.landmarks.double(), self.width, self.height)
        scale = math.hypot(*transforms[0, 0, :2].tolist())  # NaN where there is no face
        if not 0 < scale * LEAST <= self.width:
            return face
        found = self.network(cut_eyes(image, transforms, self.width, self.height).float() / 255)
        back = picture_transforms(transforms)
        points = moved(torch.cat([found.landmarks, found.iris[:, None]], 1).double(), back).float()
        deviation = found.deviation / scale
        landmarks, spread = merged_lids(
            face.landmarks, face.deviation, points[:, :6], deviation[:, :6], found.visibility
        )
        return FaceReading(
            landmarks, spread, face.visibility, face.presence, points[:, 6], found.openness, found.closed,
            found.visibility,
        )  # fmt: skip


def face_without_eyes(landmarks: Tensor, deviation: Tensor, visibility: Tensor, presence: Tensor) -> FaceReading:
    """A reading of a face (68,2), (68,), (68,), () whose eyes nobody has looked at: NaN, and hidden."""
    unknown = landmarks.new_full((2,), torch.nan)
    return FaceReading(
        landmarks, deviation, visibility, presence, landmarks.new_full((2, 2), torch.nan), unknown, unknown,
        landmarks.new_zeros(2),
    )  # fmt: skip


def graph_eye_finder(content: bytes) -> EyeFinder:
    """The finder of an eye network's graph, in ONNX Runtime on one thread.

    Args:
        content: what ``torchface.onnx.eye_network_graph.eye_network_model`` makes.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    _, _, height, width = session.get_inputs()[0].shape

    def network(crops: Tensor) -> EyeFindings:
        found = session.run(list(EyeFindings._fields), {"eyes": crops.contiguous().numpy()})
        return EyeFindings(*(torch.from_numpy(np.asarray(one)) for one in found))

    return EyeFinder(network, width, height)
