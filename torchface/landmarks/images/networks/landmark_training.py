"""Training of the landmark network on cut-out pictures with exact landmarks."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, binary_cross_entropy_with_logits
from torch.utils.data import Dataset

from torchface.files.content_keys import content_key
from torchface.landmarks.images.networks.heat_map_training import (
    check_pictures,
    draw_numbers,
    gap_loss,
    heat_loss,
    new_network,
    point_loss,
)
from torchface.landmarks.images.networks.landmark_network import STRIDE, LandmarkNetwork
from torchface.landmarks.images.networks.picture_augmentation import AugmentationSettings, Crops, augmented
from torchface.optim import DescentRun, DescentSettings, DescentTask, descend
from torchface.progress import Progress, ValueLog, silent

_METHOD = "landmark network/2"
# Pairs of landmarks whose distance is what is read off a face: how far lids and lips are open, how high brows are.
_PAIRS = torch.tensor([[37, 41], [38, 40], [43, 47], [44, 46], [61, 67], [62, 66], [63, 65], [51, 57], [48, 54],
                       [19, 37], [24, 44]])  # fmt: skip
_HEAT = 1.0  # standard deviation of the heat map asked for, cells


@dataclass(frozen=True)
class NetworkSettings(DescentSettings):
    """How a landmark network is trained.

    Args:
        pair: weight of distances between landmarks, such as between lids.
        heat: weight of the heat maps' form, which fades over the first half.
        augmentation: how widely crops are drawn.

    Example:
        >>> NetworkSettings().steps * NetworkSettings().batch  # crops that a network sees
        512000
    """

    workers: int = 1
    pair: float = 1.0
    heat: float = 0.5
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)


def fit_landmarks(
    pictures: Dataset[tuple[Tensor, ...]],
    network: LandmarkNetwork | None,
    settings: NetworkSettings | None,
    progress: Progress | None,
    checkpoint: Path | None,
    device: str | torch.device,
    log: ValueLog | None,
) -> LandmarkNetwork:
    """See :meth:`LandmarkNetwork.fit`."""
    check_pictures(pictures, "uint8 (4,H,W), landmarks (68,2) and visibility (68,)", (68, 2), (68,))
    settings = settings or NetworkSettings()
    network = network or new_network(LandmarkNetwork, settings.seed)
    learned = {"pair": settings.pair, "heat": settings.heat, "augmentation": settings.augmentation}
    task = DescentTask(
        partial(_crops, pictures, network.size, network.margin, settings),
        partial(_loss, network, settings, device),
        content_key(_METHOD, settings=learned, config=network.config),
        "training the network",
        "pixels off",
    )
    return descend(network, task, settings, DescentRun(progress or silent, log, checkpoint, device))


def _crops(
    pictures: Dataset[tuple[Tensor, ...]], size: int, margin: float, settings: NetworkSettings, step: int
) -> Crops:
    numbers, generator = draw_numbers(pictures, settings, step)
    rgba, landmarks, visible = pictures[numbers]
    return augmented(rgba, landmarks, visible, size, margin, generator, settings.augmentation)


def _loss(
    network: LandmarkNetwork, settings: NetworkSettings, device: str | torch.device, crops: Crops, share: float
) -> tuple[Tensor, float]:
    """The loss of a batch, and the mean distance of what can be seen, pixels."""
    images, truth = crops.images.to(device, memory_format=torch.channels_last), crops.landmarks.to(device)
    visible, present = crops.visible.to(device), crops.present.to(device)
    heat, features, logit = network.maps(images)
    reading = network.read(heat, features, logit)
    within = ((truth > 1) & (truth < network.size - 2)).all(-1).float()
    weight = within * (0.4 + 0.6 * visible) * present[:, None]
    places, distance = point_loss(reading.landmarks, truth, reading.deviation, weight)
    pairs = gap_loss(reading.landmarks, truth, weight, _PAIRS, 2)
    fading = settings.heat * max(0.0, 1 - 2 * share) + 0.05
    form = heat_loss(heat, truth, weight, STRIDE, _HEAT)
    hidden = binary_cross_entropy(reading.visibility.clamp(1e-5, 1 - 1e-5), visible, reduction="none")
    hidden = (hidden * within * present[:, None]).sum() / weight.sum().clamp(min=1)
    absent = binary_cross_entropy_with_logits(logit, present)
    loss = places + settings.pair * pairs + fading * form + hidden + absent
    clear = within * visible * present[:, None]
    return loss, float((distance * clear).sum() / clear.sum().clamp(min=1))
