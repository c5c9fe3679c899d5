"""The network of face boxes as a detector: any image in, boxes and roll angles out."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.files.model_roots import shipped_model
from torchface.files.models import read_model
from torchface.landmarks.images.boxes.box_network import INPUT_SIZE, BoxNetwork
from torchface.landmarks.images.boxes.face_box import FaceBoxes, check_image, one_each, shrunk, sorted_boxes
from torchface.landmarks.images.folded_normalisation import without_normalisation

_MULTIPLE = 32  # pixels: the stride of the network's coarsest level
_LEAST_SCORE = 0.4  # of a face
_SURE_SCORE = 0.55  # of the shipped network: four turns show four times as much that is no face


class NetworkDetector:
    """Faces at every roll angle, from 24 pixels in an image of 640.

    Args:
        network: what finds them.
        least_score: faces of lower score are none.
        longest: the image is made smaller until its longer side has so many pixels.

    Raises:
        ValueRangeError: no such score or length.

    Example:
        >>> from torchface import zoo
        >>> detector = NetworkDetector(zoo.get_model("face_boxes"))
        >>> len(detector(torch.full((3, 120, 160), 128, dtype=torch.uint8)).boxes)
        0
    """

    def __init__(self, network: BoxNetwork, least_score: float = _LEAST_SCORE, longest: int = INPUT_SIZE) -> None:
        if not (0 < least_score < 1 and longest >= 64):
            raise ValueRangeError(
                f"NetworkDetector: found score {least_score}, longest {longest}; expected (0,1), from 64"
            )
        self.network = network
        self.least_score, self.longest = least_score, longest
        self._fused = without_normalisation(network).float()  # images are
        self._fused.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @torch.inference_mode()
    def __call__(self, image: Tensor) -> FaceBoxes:
        check_image(image)
        pixels = (image if image.ndim == 3 else image.expand(3, *image.shape)).cpu()
        height, width = pixels.shape[1:]
        scale = min(1.0, self.longest / max(height, width))
        if scale < 1:
            small = shrunk(np.ascontiguousarray(pixels.permute(1, 2, 0).numpy()), scale)
            pixels = torch.from_numpy(small).permute(2, 0, 1)
        ratio = torch.tensor([width / pixels.shape[2], height / pixels.shape[1]])
        faces = self._fused(_padded(pixels)[None].float() / 255)[0].clone()
        faces = faces[faces[:, 3] >= self.least_score]
        middle = (faces[:, :2] + 0.5) * ratio - 0.5
        side = faces[:, 2:3] * ratio.mean()
        boxes = torch.cat([middle - side / 2, side, side], 1)
        best, tilts = one_each(boxes, faces[:, 3]), torch.atan2(faces[:, 5], faces[:, 4])
        return sorted_boxes(boxes[best], faces[best, 3], tilts[best])


@cache
def shipped_detector() -> NetworkDetector:
    """The detector of the zoo's ``face_boxes``, read once.

    Raises:
        FileFormatError: it is missing or damaged.
    """
    network = read_model(shipped_model("face_boxes"), {"face_boxes": BoxNetwork})
    return NetworkDetector(network, _SURE_SCORE)


def _padded(pixels: Tensor) -> Tensor:
    """An image (3,H,W), its last rows and columns repeated until they are as many as the network asks for."""
    height, width = pixels.shape[1:]
    wanted = [max(2, -(-side // _MULTIPLE)) * _MULTIPLE for side in (height, width)]
    rows = torch.arange(wanted[0]).clamp(max=height - 1)
    columns = torch.arange(wanted[1]).clamp(max=width - 1)
    return pixels[:, rows][:, :, columns]
