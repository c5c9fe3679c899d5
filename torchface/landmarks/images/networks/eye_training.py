"""Training of the eye network on cut-out pictures of eyes whose lids and irises are known."""

from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy
from torch.utils.data import Dataset

from torchface.files.content_keys import content_key
from torchface.landmarks.images.networks.eye_augmentation import EyeAugmentation, EyeCrops, EyeLabels, augmented_eyes
from torchface.landmarks.images.networks.eye_network import STRIDE, EyeNetwork
from torchface.landmarks.images.networks.heat_map_training import (
    check_pictures,
    draw_numbers,
    gap_loss,
    heat_loss,
    point_loss,
)
from torchface.optim import DescentSettings, DescentTask

_METHOD = "eye network/2"
_LIDS = torch.tensor([[1, 5], [2, 4]])  # upper and lower landmarks, opposite each other
_HEAT = 1.2  # standard deviation of the heat map asked for, cells
_NARROW = 0.03  # of the lids' opening: errors below count with their square


@dataclass(frozen=True)
class EyeSettings(DescentSettings):
    """How an eye network is trained."""

    steps: int = 5000
    batch: int = 128
    rate: float = 3e-3
    gap: float = 1.5  # weight of the distance between the lids
    heat: float = 0.5  # weight of the heat maps' form, which fades over the first half
    augmentation: EyeAugmentation = field(default_factory=EyeAugmentation)  # how widely crops are drawn


def eye_task(
    network: EyeNetwork, pictures: Dataset[tuple[Tensor, ...]], settings: EyeSettings, device: str | torch.device
) -> DescentTask[EyeCrops]:
    """What a network learns of pictures; see :class:`EyeNetwork`."""
    check_pictures(
        pictures,
        "uint8 (4,H,W), landmarks (68,2), visibility (12,), irises (2,2), openness (2,) and bare eyeball (2,)",
        (68, 2), (12,), (2, 2), (2,), (2,),
    )  # fmt: skip
    learned = {"gap": settings.gap, "heat": settings.heat, "augmentation": settings.augmentation}
    return DescentTask(
        partial(_crops, pictures, (network.width, network.height), settings),
        partial(_loss, network, settings, device),
        content_key(_METHOD, settings=learned, config=network.config),
        "training on eyes",
        "pixels off",
    )


def _crops(pictures: Dataset[tuple[Tensor, ...]], size: tuple[int, int], settings: EyeSettings, step: int) -> EyeCrops:
    numbers, generator = draw_numbers(pictures, settings, step)
    eyes = torch.randint(2, (settings.batch,), generator=generator)
    rgba, *labels = pictures[numbers]
    return augmented_eyes(rgba, EyeLabels(*labels), eyes, *size, generator, settings.augmentation)


def _loss(
    network: EyeNetwork, settings: EyeSettings, device: str | torch.device, crops: EyeCrops, share: float
) -> tuple[Tensor, float]:
    """The loss of a batch, and the mean distance of what can be seen, pixels."""
    images, truth = crops.images.to(device, memory_format=torch.channels_last), crops.points.to(device)
    seen, present = crops.seen.to(device), crops.present.to(device)
    heat, features, pooled = network.maps(images)
    reading = network.read(heat, features, pooled)
    points = torch.cat([reading.landmarks, reading.iris[:, None]], dim=1)
    within = ((truth > 1) & (truth < truth.new_tensor([network.width, network.height]) - 2)).all(-1).float()
    weight = within * (0.3 + 0.7 * seen) * present[:, None]
    weight[:, 6] = within[:, 6] * (0.05 + 0.95 * seen[:, 6]) * present  # irises behind lids are a guess
    places, distance = point_loss(points, truth, reading.deviation, weight)
    gaps = gap_loss(points, truth, weight, _LIDS, 3)
    fading = settings.heat * max(0.0, 1 - 2 * share) + 0.05
    form = heat_loss(heat, truth, weight, STRIDE, _HEAT)
    visible = crops.visibility.to(device)
    trust = present * (0.2 + 0.8 * visible)
    off = (reading.openness - crops.openness.to(device)).abs()
    opened = ((off.square() + _NARROW**2).sqrt() - _NARROW) / _NARROW
    shut = binary_cross_entropy(reading.closed.clamp(1e-5, 1 - 1e-5), crops.closed.to(device), reduction="none")
    whole = ((opened + 2 * shut) * trust).sum() / trust.sum().clamp(min=1)
    hidden = binary_cross_entropy(reading.visibility.clamp(1e-5, 1 - 1e-5), visible)
    loss = places + settings.gap * gaps + fading * form + whole + hidden
    clear = within * seen * present[:, None]
    return loss, float((distance * clear).sum() / clear.sum().clamp(min=1))
