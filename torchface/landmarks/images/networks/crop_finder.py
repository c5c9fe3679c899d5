"""Landmarks by a network that is shown an upright crop of the face."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.landmarks.images.face_crop import CROP_MARGIN, crop_transform, cut_crop, from_crop
from torchface.landmarks.images.face_reading import FaceReading, box_side
from torchface.landmarks.images.ibug_68 import COUNT, MIRROR_68
from torchface.landmarks.images.networks.landmark_network import NetworkLandmarks
from torchface.shape_names import ARKIT, mirror

CropNetwork = Callable[[Tensor], NetworkLandmarks]  # crops (B,3,S,S) float32 in [0,1], red first, to what they show

_NO_POINTS = torch.zeros(0, dtype=torch.int64)
_TWINS = mirror(ARKIT)


@dataclass(frozen=True, eq=False)
class BothSides:
    """A network that is shown each crop and its mirror image, and the mean of what it finds in the two."""

    network: CropNetwork
    mirror: Tensor = _NO_POINTS  # which of the network's points each becomes when the picture is mirrored, (P,) int64

    def __call__(self, crops: Tensor) -> NetworkLandmarks:
        last = crops.shape[-1] - 1
        both = self.network(torch.cat([crops, crops.flip(-1)]))  # at once, which is a sixth quicker
        upright, mirrored = (NetworkLandmarks(*half) for half in zip(*(one.chunk(2) for one in both), strict=True))
        rows, twins = list(MIRROR_68), _TWINS
        landmarks, deviation = _merged(upright[:2], (mirrored.landmarks[:, rows], mirrored.deviation[:, rows]), last)
        across = mirrored.points[:, self.mirror], mirrored.point_deviation[:, self.mirror]
        points, point_deviation = _merged(upright[4:6], across, last)
        return NetworkLandmarks(
            landmarks,
            deviation,
            (upright.visibility + mirrored.visibility[:, rows]) / 2,
            (upright.presence + mirrored.presence) / 2,
            points,
            point_deviation,
            (upright.expression + mirrored.expression[:, twins]) / 2,
            (upright.expression_deviation + mirrored.expression_deviation[:, twins]) / 2,
        )


def _merged(upright: tuple[Tensor, ...], mirrored: tuple[Tensor, ...], last: int) -> tuple[Tensor, Tensor]:
    """Points and deviations of both sides together; the mirror image's points have the other's order already."""
    across = mirrored[0] * mirrored[0].new_tensor([-1.0, 1.0]) + mirrored[0].new_tensor([last, 0.0])
    # Where the two disagree a point is less sure than either says.
    apart = (upright[0] - across).norm(dim=-1) / 2
    deviation = ((upright[1] + mirrored[1]) / 2).square().add(apart.square()).sqrt()
    return (upright[0] + across) / 2, deviation


@dataclass(frozen=True, eq=False)
class CropFinder:
    """Finds landmarks by showing a network the face's box, turned upright."""

    network: CropNetwork
    size: int  # pixels a side of a crop, S
    margin: float = CROP_MARGIN  # a crop's side in sides of the face's box
    name: str = "landmark network"

    @torch.no_grad()
    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FaceReading:
        """See :class:`~torchface.landmarks.images.landmark_finder.LandmarkFinder`."""
        transform = crop_transform(box, tilt, self.size, self.margin)
        crop = cut_crop(image, transform, self.size)
        found = self.network(crop[None].float() / 255)
        shapes = tuple(tuple(one.shape) for one in found[:4])
        if shapes != ((1, COUNT, 2), (1, COUNT), (1, COUNT), (1,)):
            raise ShapeError(
                f"{self.name}: found {shapes}, expected landmarks (1,{COUNT},2), deviation (1,{COUNT}), visibility "
                f"(1,{COUNT}) and presence (1,)"
            )
        one = NetworkLandmarks(*(value[0].float().cpu() for value in found))
        scale = box_side(box) * (self.margin / self.size)  # pixels of the image a pixel of the crop
        places = from_crop(torch.cat([one.landmarks, one.points]), transform)
        return FaceReading(
            places[:COUNT], scale * one.deviation, one.visibility, one.presence,
            points=places[COUNT:], point_deviation=scale * one.point_deviation,
            expression=one.expression, expression_deviation=one.expression_deviation,
            search_box=box.to(one.landmarks),
        )  # fmt: skip
