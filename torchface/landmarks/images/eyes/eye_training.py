"""How the eye network learns from cut-out pictures of eyes whose lids and irises are known."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy

from torchface.errors import ShapeError
from torchface.files.content_keys import content_key
from torchface.landmarks.images.eyes.eye_augmentation import EyeAugmentation, EyeCrops, EyeLabels, augmented_eyes
from torchface.landmarks.images.eyes.eye_network import STRIDE, EyeFindings, EyeNetwork
from torchface.optim import DescentRun, DescentSettings, DescentTask, descend
from torchface.progress import Progress, ValueLog, silent

_METHOD = "eye network/2"
_UPPER, _LOWER = (1, 2), (5, 4)  # of the lids' landmarks, opposite each other
_HEAT = 1.2  # standard deviation of the heat map asked for, cells
_NARROW = 0.03  # of the lids' opening: errors below count with their square


@dataclass(frozen=True)
class EyeSettings(DescentSettings):
    """How an eye network is trained.

    Args:
        gap: weight of the distance between the lids.
        heat: weight of the heat maps' form, which fades over the first half.
        augmentation: how widely crops are drawn.
    """

    steps: int = 5000
    batch: int = 128
    rate: float = 3e-3
    gap: float = 1.5
    heat: float = 0.5
    augmentation: EyeAugmentation = field(default_factory=EyeAugmentation)


class LabelledEyes(Protocol):
    """Cut-out pictures of both eyes and what is known of them, read some at a time: of tensors or of files."""

    def __len__(self) -> int: ...

    def rows(self, numbers: Tensor) -> tuple[Tensor, EyeLabels]:
        """Pictures uint8 (B,4,H,W) and what is known of them, of numbers (B,)."""
        ...


@dataclass(frozen=True, eq=False)
class _InMemory:
    """Pictures (M,4,H,W) and their labels."""

    rgba: Tensor
    labels: EyeLabels

    def __len__(self) -> int:
        return len(self.rgba)

    def rows(self, numbers: Tensor) -> tuple[Tensor, EyeLabels]:
        return self.rgba[numbers], self.labels.rows(numbers)


def fit_eyes(
    rgba: Tensor,
    labels: EyeLabels,
    network: EyeNetwork | None = None,
    settings: EyeSettings | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
    device: str | torch.device = "cpu",
) -> EyeNetwork:
    r"""Trains an eye network on pictures.

    .. math:: \sum_l v_l \Bigl( r_l + 3 \ln(1 + r_l / 0.7) + \tfrac{r_l}{\sigma_l} + 2 \ln \sigma_l \Bigr)
        + \text{gap of the lids} + \text{form of heat maps} + \text{openness} + \text{cross entropies}

    with :math:`r_l` the distance from the truth in pixels of the crop; see
    :func:`torchface.landmarks.images.network_training.fit_network`.

    Args:
        rgba: cut-out pictures of both eyes, uint8 (M,4,H,W); see ``synthetic.stages.face_pictures.eye_picture``.
        labels: what is known of them.
        network: goes on from its weights; a new one if absent.
        settings: how.
        progress: called with each step and how far it is.
        checkpoint: a file that is kept while it runs, and taken up by the next run with the same settings.
        device: where the network computes.

    Returns:
        The running mean of the weights, in evaluation mode, on the CPU.

    Raises:
        ShapeError: other shapes.
    """
    if rgba.ndim != 4 or rgba.shape[1] != 4 or rgba.dtype != torch.uint8 or not len(rgba):
        raise ShapeError(f"rgba: found {rgba.dtype} {tuple(rgba.shape)}, expected uint8 (M,4,H,W) with a picture")
    if labels.landmarks.shape != (len(rgba), 68, 2) or labels.iris.shape != (len(rgba), 2, 2):
        raise ShapeError(
            f"labels: found landmarks {tuple(labels.landmarks.shape)} and irises {tuple(labels.iris.shape)}, expected "
            f"({len(rgba)},68,2) and ({len(rgba)},2,2)"
        )
    return fit_eye_rows(_InMemory(rgba, labels), network, settings, progress, checkpoint, device)


def fit_eye_rows(
    pictures: LabelledEyes,
    network: EyeNetwork | None = None,
    settings: EyeSettings | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
    device: str | torch.device = "cpu",
    log: ValueLog | None = None,
) -> EyeNetwork:
    """What :func:`fit_eyes` learns, from pictures that a ``DataLoader``'s workers read a batch at a time.

    Args:
        pictures: at least one; those of a batch are asked for by their numbers.
        log: called with what was measured, every fifty steps.

    All others: as :func:`fit_eyes`.
    """
    settings, progress = settings or EyeSettings(), progress or silent
    if network is None:
        with torch.random.fork_rng([]):
            torch.manual_seed(settings.seed)
            network = EyeNetwork()
    chosen = network

    def loss(crops: EyeCrops, share: float) -> tuple[Tensor, float]:
        return _loss(chosen, crops, settings, share, device)

    own = {"gap": settings.gap, "heat": settings.heat, "augmentation": settings.augmentation}
    task = DescentTask(
        partial(_crops, pictures, (network.width, network.height), settings),
        loss,
        content_key(_METHOD, settings=own, config=network.config),
        "training on eyes",
        "pixels off",
    )
    return descend(network, task, settings, DescentRun(progress, log, checkpoint, device))


def _crops(pictures: LabelledEyes, size: tuple[int, int], settings: EyeSettings, step: int) -> EyeCrops:
    generator = torch.Generator().manual_seed(1_000_003 * settings.seed + step)
    rows = torch.randint(len(pictures), (settings.batch,), generator=generator)
    eyes = torch.randint(2, (settings.batch,), generator=generator)
    rgba, labels = pictures.rows(rows)
    return augmented_eyes(rgba, labels, eyes, *size, generator, settings.augmentation)


def _loss(
    network: EyeNetwork, crops: EyeCrops, settings: EyeSettings, share: float, device: str | torch.device
) -> tuple[Tensor, float]:
    """The loss of a batch, and the mean distance of what can be seen, pixels."""
    images, truth = crops.images.to(device, memory_format=torch.channels_last), crops.points.to(device)
    seen, present = crops.seen.to(device), crops.present.to(device)
    heat, features, pooled = network.maps(images)
    found: EyeFindings = network.read(heat, features, pooled)
    points = torch.cat([found.landmarks, found.iris[:, None]], dim=1)
    within = ((truth > 1) & (truth < truth.new_tensor([network.width, network.height]) - 2)).all(-1).float()
    weight = within * (0.3 + 0.7 * seen) * present[:, None]
    weight[:, 6] = within[:, 6] * (0.05 + 0.95 * seen[:, 6]) * present  # irises behind lids are a guess
    total = weight.sum().clamp(min=1)
    distance = ((points - truth).square().sum(-1) + 1e-6).sqrt()
    near = distance + 3 * torch.log1p(distance / 0.7)
    told = distance.detach() / found.deviation + 2 * found.deviation.log()
    places = ((near + 0.5 * told) * weight).sum() / total
    upper, lower = list(_UPPER), list(_LOWER)
    apart = (points[:, upper] - points[:, lower]) - (truth[:, upper] - truth[:, lower])
    apart_weight = weight[:, upper] * weight[:, lower]
    size = (apart.square().sum(-1) + 1e-6).sqrt()
    gaps = ((size + 3 * torch.log1p(size / 0.5)) * apart_weight).sum() / apart_weight.sum().clamp(min=1)
    form = (_heat_form(network, heat, truth) * weight).sum() / total
    fading = settings.heat * max(0.0, 1 - 2 * share) + 0.05
    there = crops.visibility.to(device)
    told_weight = present * (0.2 + 0.8 * there)
    off = (found.openness - crops.openness.to(device)).abs()
    opened = ((off.square() + _NARROW**2).sqrt() - _NARROW) / _NARROW
    shut = binary_cross_entropy(found.closed.clamp(1e-5, 1 - 1e-5), crops.closed.to(device), reduction="none")
    whole = ((opened + 2 * shut) * told_weight).sum() / told_weight.sum().clamp(min=1)
    hidden = binary_cross_entropy(found.visibility.clamp(1e-5, 1 - 1e-5), there)
    loss = places + settings.gap * gaps + fading * form + whole + hidden
    clear = within * seen * present[:, None]
    return loss, float((distance.detach() * clear).sum() / clear.sum().clamp(min=1))


def _heat_form(network: EyeNetwork, heat: Tensor, truth: Tensor) -> Tensor:
    """Cross entropy (B,7) of heat maps with a Gaussian about the truth."""
    squared = (network.places(heat) - truth[:, :, None]).square().sum(-1) / STRIDE**2
    wanted = torch.softmax(-squared / (2 * _HEAT**2), dim=-1)
    return -(wanted * heat.flatten(2).log_softmax(-1)).sum(-1)
