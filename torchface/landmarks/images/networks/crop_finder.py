"""Landmarks by a network that is shown an upright crop of the face."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.landmarks.images.face_crop import CROP_MARGIN, crop_transform, cut_crop, from_crop
from torchface.landmarks.images.face_reading import FaceReading, box_side
from torchface.landmarks.images.ibug_68 import COUNT, MIRROR_68

CropNetwork = Callable[[Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]
"""Crops (B,3,S,S) float32 in [0,1], red first, to landmarks (B,68,2) and their deviations (B,68), pixels of the crop,
visibility (B,68) and presence (B,), each in [0,1]."""


@dataclass(frozen=True, eq=False)
class BothSides:
    """A network that is shown each crop and its mirror image, and the mean of what it finds in the two.

    Args:
        network: see ``CropNetwork``.
    """

    network: CropNetwork

    def __call__(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        rows, last = list(MIRROR_68), crops.shape[-1] - 1
        upright, mirrored = self.network(crops), self.network(crops.flip(-1).contiguous())
        across = mirrored[0][:, rows] * mirrored[0].new_tensor([-1.0, 1.0]) + mirrored[0].new_tensor([last, 0.0])
        landmarks = (upright[0] + across) / 2
        # Where the two disagree the landmark is less sure than either says.
        apart = (upright[0] - across).norm(dim=-1) / 2
        deviation = ((upright[1] + mirrored[1][:, rows]) / 2).square().add(apart.square()).sqrt()
        return landmarks, deviation, (upright[2] + mirrored[2][:, rows]) / 2, (upright[3] + mirrored[3]) / 2


@dataclass(frozen=True, eq=False)
class CropFinder:
    """Finds landmarks by showing a network the face's box, turned upright.

    Args:
        network: what finds them in crops.
        size: pixels a side of a crop, S.
        margin: a crop's side in sides of the face's box.
        name: what messages call it.
    """

    network: CropNetwork
    size: int
    margin: float = CROP_MARGIN
    name: str = "landmark network"

    @torch.no_grad()
    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        """See :class:`~torchface.landmarks.images.landmark_finder.LandmarkFinder`."""
        transform = crop_transform(box, tilt, self.size, self.margin)
        crop = cut_crop(image, transform, self.size)
        outputs = self.network(crop[None].float() / 255)
        shapes = tuple(tuple(one.shape) for one in outputs)
        if shapes != ((1, COUNT, 2), (1, COUNT), (1, COUNT), (1,)):
            raise ShapeError(
                f"{self.name}: found {shapes}, expected landmarks (1,{COUNT},2), deviation (1,{COUNT}), visibility "
                f"(1,{COUNT}) and presence (1,)"
            )
        landmarks, deviation, visibility, presence = (one[0].detach().float().cpu() for one in outputs)
        scale = box_side(box) * (self.margin / self.size)  # pixels of the image a pixel of the crop
        return FaceReading(
            from_crop(landmarks, transform), scale * deviation, visibility, presence, search_box=box.to(landmarks)
        )
