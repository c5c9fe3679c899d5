"""Training of the network of a face's parts on pictures whose every pixel is known."""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cross_entropy, one_hot
from torch.utils.data import Dataset

from torchface.errors import ShapeError
from torchface.files.content_keys import content_key
from torchface.landmarks.images.networks.heat_map_training import draw_numbers
from torchface.landmarks.images.networks.part_network import PART_MARGIN, PART_SIZE, PARTS, PartNetwork
from torchface.landmarks.images.networks.picture_augmentation import AugmentationSettings, photographed, to_crop_maps
from torchface.optim import DescentSettings, DescentTask

_METHOD = "part network/2"
_RARE = torch.tensor([1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 2.0, 1.0, 1.0])  # of brows, eyes, lips, teeth, glasses


@dataclass(frozen=True)
class PartSettings(DescentSettings):
    """How a network of parts is trained."""

    steps: int = 9000
    batch: int = 24
    rate: float = 4e-3
    turn: float = 9.0  # standard deviation of a face's tilt in its crop, degrees
    scale: float = 0.2  # how much larger or smaller than its box a face may be, as a logarithm
    shift: float = 0.06  # standard deviation of its place, of the box
    grey: float = 0.12  # share of crops without colour
    bfloat16: float = 0.0  # share of the steps, the first, whose convolutions compute in bfloat16


class PartCrops(NamedTuple):
    """Crops (B,3,S,S) in [0,1] and the parts of their pixels, int64 (B,S,S); -1 where nothing is known."""

    images: Tensor
    parts: Tensor


def part_task(
    network: PartNetwork, pictures: Dataset[tuple[Tensor, ...]], settings: PartSettings, device: str | torch.device
) -> DescentTask[PartCrops]:
    """What a network learns of pictures; see :class:`PartNetwork`."""
    count: int = len(pictures)  # type: ignore[arg-type]  # data sets by number have a length
    images, parts, boxes = pictures[torch.arange(min(count, 1))]
    fits = images.dtype == parts.dtype == torch.uint8 and images.shape[1:2] == (3,)
    if not count or not fits or parts.shape != (1, *images.shape[2:]) or boxes.shape != (1, 4):
        raise ShapeError(
            f"pictures: found {count}, of the first {images.dtype} {tuple(images.shape)}, {parts.dtype} "
            f"{tuple(parts.shape)}, {tuple(boxes.shape)}; expected one at least, uint8 (1,3,H,W), uint8 (1,H,W), (1,4)"
        )
    names = ("turn", "scale", "shift", "grey", "bfloat16")
    return DescentTask(
        partial(_draw, pictures, settings),
        partial(_loss, network, settings, device),
        content_key(_METHOD, settings={name: getattr(settings, name) for name in names}, config=network.config),
        "training on parts of faces",
        "% of the pixels wrong",
    )


def _draw(pictures: Dataset[tuple[Tensor, ...]], settings: PartSettings, step: int) -> PartCrops:
    numbers, generator = draw_numbers(pictures, settings, step)
    images, parts, boxes = pictures[numbers]
    return part_crops(images, parts, boxes, generator, settings)


def part_crops(
    images: Tensor, parts: Tensor, boxes: Tensor, generator: torch.Generator, settings: PartSettings
) -> PartCrops:
    """A crop of each picture, mirrored or not, in another light; see :meth:`PartNetwork.fit` for what is given."""
    count, last = len(images), images.shape[-1] - 1.0
    given = AugmentationSettings(grey=settings.grey)
    mirrored = torch.rand(count, generator=generator) < 0.5
    boxes = torch.where(mirrored[:, None], torch.stack([last - boxes[:, 0] - boxes[:, 2], *boxes.T[1:]], 1), boxes)
    shift = settings.shift * torch.randn(count, 2, generator=generator).clamp(-2.5, 2.5)
    side = boxes[:, 2] * PART_MARGIN * (settings.scale * (2 * torch.rand(count, generator=generator) - 1)).exp()
    turn = torch.deg2rad(settings.turn * torch.randn(count, generator=generator))
    maps = to_crop_maps(boxes[:, :2] + (0.5 + shift) * boxes[:, 2:], side, turn, PART_SIZE)
    maps[..., 2] += torch.where(mirrored, last, 0.0)[:, None] * maps[..., 0]
    maps[..., 0] *= torch.where(mirrored, -1.0, 1.0)[:, None]
    size = (PART_SIZE, PART_SIZE)
    cut, known = [], []
    for picture, part, way in zip(
        images.permute(0, 2, 3, 1).numpy(), parts.numpy(), maps.double().numpy(), strict=True
    ):
        cut.append(cv2.warpAffine(np.ascontiguousarray(picture), way, size, borderMode=cv2.BORDER_REPLICATE))
        known.append(cv2.warpAffine(part, way, size, flags=cv2.INTER_NEAREST, borderValue=255))
    shown = torch.from_numpy(np.stack(cut)).permute(0, 3, 1, 2).float() / 255
    numbers = torch.from_numpy(np.stack(known)).long()
    return PartCrops(photographed(shown, given, generator), torch.where(numbers < len(PARTS), numbers, -1))


def _loss(
    network: PartNetwork, settings: PartSettings, device: str | torch.device, crops: PartCrops, share: float
) -> tuple[Tensor, float]:
    r"""The loss of a batch and how many of its pixels are given another part, %.

    Cross entropy, and :math:`1 - 2 |A \cap B| / (|A| + |B|)` in the mean of the parts.
    """
    images, parts = crops.images.to(device, memory_format=torch.channels_last), crops.parts.to(device)
    with torch.autocast(images.device.type, torch.bfloat16, enabled=share < settings.bfloat16):
        scores = network.logits(images).float()
    known = parts >= 0
    truth = one_hot(parts.clamp(min=0), len(PARTS)).permute(0, 3, 1, 2) * known[:, None]
    shares = scores.softmax(1) * known[:, None]
    both, total = (shares * truth).sum((0, 2, 3)), (shares + truth).sum((0, 2, 3))
    loss = cross_entropy(scores, parts, _RARE.to(scores), ignore_index=-1) + 1 - (2 * both / (total + 1)).mean()
    return loss, 100 * float(((scores.detach().argmax(1) != parts) & known).sum() / known.sum())
