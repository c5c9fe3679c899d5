"""How the landmark network learns from cut-out pictures with exact landmarks."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.files.content_keys import content_key
from torchface.landmarks.images.network import LandmarkNetwork, NetworkLandmarks
from torchface.landmarks.images.picture_augmentation import AugmentationSettings, Crops, augmented
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


class LabelledPictures(Protocol):
    """Cut-out faces with their landmarks, read some at a time: of a tensor or of files."""

    def __len__(self) -> int: ...

    def rows(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Pictures uint8 (B,4,H,W), landmarks (B,68,2) and which of them are visible (B,68) bool, of numbers (B,)."""
        ...


@dataclass(frozen=True, eq=False)
class _InMemory:
    """Pictures (M,4,H,W), landmarks (M,68,2), visible (M,68)."""

    rgba: Tensor
    landmarks: Tensor
    visible: Tensor

    def __len__(self) -> int:
        return len(self.rgba)

    def rows(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.rgba[numbers], self.landmarks[numbers], self.visible[numbers]


def fit_network(
    rgba: Tensor,
    landmarks: Tensor,
    visible: Tensor,
    network: LandmarkNetwork | None = None,
    settings: NetworkSettings | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
    device: str | torch.device = "cpu",
) -> LandmarkNetwork:
    r"""Trains a landmark network on pictures.

    .. math:: \sum_l v_l \Bigl( r_l + 3 \ln(1 + r_l / 0.7) + \tfrac{r_l}{\sigma_l} + 2 \ln \sigma_l \Bigr)
        + \text{distances of pairs} + \text{form of heat maps} + \text{cross entropy of } v \text{ and presence}

    with :math:`r_l` the distance from the truth in pixels of the crop: linear far away, steep near the truth, so that
    neither what is hidden nor what is already good decides alone. :math:`\sigma` learns from the likelihood without
    pulling on the places.

    Args:
        rgba: cut-out faces, uint8 (M,4,H,W); see ``synthetic.stages.face_pictures``.
        landmarks: iBUG's 68, (M,68,2) pixels.
        visible: which of them nothing hides, (M,68) bool.
        network: goes on from its weights; a new one if absent.
        settings: how.
        progress: called with each step and how far it is.
        checkpoint: a file that is kept while it runs, and taken up by the next run with the same settings; more
            pictures may have come by then.
        device: where the network computes.

    Returns:
        The running mean of the weights, in evaluation mode, on the CPU.

    Raises:
        ShapeError: other shapes.

    Source: Feng et al. 2018 (a loss that is steep near zero); Kumar et al. 2020 (likelihood with visibility).
    """
    if rgba.ndim != 4 or rgba.shape[1] != 4 or rgba.dtype != torch.uint8 or not len(rgba):
        raise ShapeError(f"rgba: found {rgba.dtype} {tuple(rgba.shape)}, expected uint8 (M,4,H,W) with a picture")
    if landmarks.shape != (len(rgba), 68, 2) or visible.shape != (len(rgba), 68):
        raise ShapeError(
            f"landmarks: found {tuple(landmarks.shape)} and {tuple(visible.shape)}, expected ({len(rgba)},68,2) and "
            f"({len(rgba)},68)"
        )
    return fit_network_rows(_InMemory(rgba, landmarks, visible), network, settings, progress, checkpoint, device)


def fit_network_rows(
    pictures: LabelledPictures,
    network: LandmarkNetwork | None = None,
    settings: NetworkSettings | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
    device: str | torch.device = "cpu",
    log: ValueLog | None = None,
) -> LandmarkNetwork:
    """What :func:`fit_network` learns, from pictures that a ``DataLoader``'s workers read a batch at a time.

    Args:
        pictures: at least one; those of a batch are asked for by their numbers.
        log: called with what was measured, every fifty steps.

    All others: as :func:`fit_network`.
    """
    settings, progress = settings or NetworkSettings(), progress or silent
    if network is None:
        with torch.random.fork_rng([]):
            torch.manual_seed(settings.seed)
            network = LandmarkNetwork()
    chosen = network

    def loss(crops: Crops, share: float) -> tuple[Tensor, float]:
        return _loss(chosen, crops, settings, share, device)

    own = {"pair": settings.pair, "heat": settings.heat, "augmentation": settings.augmentation}
    task = DescentTask(
        partial(_crops, pictures, network.size, network.margin, settings),
        loss,
        content_key(_METHOD, settings=own, config=network.config),
        "training the network",
        "pixels off",
    )
    return descend(network, task, settings, DescentRun(progress, log, checkpoint, device))


def _crops(pictures: LabelledPictures, size: int, margin: float, settings: NetworkSettings, step: int) -> Crops:
    generator = torch.Generator().manual_seed(1_000_003 * settings.seed + step)
    numbers = torch.randint(len(pictures), (settings.batch,), generator=generator)
    return augmented(*pictures.rows(numbers), size, margin, generator, settings.augmentation)


def _loss(
    network: LandmarkNetwork, crops: Crops, settings: NetworkSettings, share: float, device: str | torch.device
) -> tuple[Tensor, float]:
    """The loss of a batch, and the mean distance of what can be seen, pixels."""
    images, truth = crops.images.to(device, memory_format=torch.channels_last), crops.landmarks.to(device)
    visible, present = crops.visible.to(device), crops.present.to(device)
    heat, features, logit = network.maps(images)
    found: NetworkLandmarks = network.read(heat, features, logit)
    within = ((truth > 1) & (truth < network.size - 2)).all(-1).float()
    weight = within * (0.4 + 0.6 * visible) * present[:, None]
    total = weight.sum().clamp(min=1)
    distance = ((found.landmarks - truth).square().sum(-1) + 1e-6).sqrt()
    near = distance + 3 * torch.log1p(distance / 0.7)
    told = distance.detach() / found.deviation + 2 * found.deviation.log()
    first, second = _PAIRS.to(device).unbind(1)
    apart = (found.landmarks[:, first] - found.landmarks[:, second]) - (truth[:, first] - truth[:, second])
    pair_weight = weight[:, first] * weight[:, second]
    size = (apart.square().sum(-1) + 1e-6).sqrt()
    pairs = ((size + 2 * torch.log1p(size / 0.5)) * pair_weight).sum() / pair_weight.sum().clamp(min=1)
    fading = settings.heat * max(0.0, 1 - 2 * share) + 0.05
    form = (_heat_form(network, heat, truth) * weight).sum() / total
    seen = torch.nn.functional.binary_cross_entropy(found.visibility.clamp(1e-5, 1 - 1e-5), visible, reduction="none")
    seen = (seen * within * present[:, None]).sum() / total
    there = torch.nn.functional.binary_cross_entropy_with_logits(logit, present)
    places = ((near + 0.5 * told) * weight).sum() / total
    loss = places + settings.pair * pairs + fading * form + seen + there
    clear = within * visible * present[:, None]
    return loss, float((distance.detach() * clear).sum() / clear.sum().clamp(min=1))


def _heat_form(network: LandmarkNetwork, heat: Tensor, truth: Tensor) -> Tensor:
    """Cross entropy (B,68) of heat maps with a Gaussian about the truth."""
    cell = float(network.size // heat.shape[-1])
    squared = (network.places(heat) / cell - (truth / cell)[:, :, None]).square().sum(-1)
    wanted = torch.softmax(-squared / (2 * _HEAT**2), dim=-1)
    return -(wanted * heat.flatten(2).log_softmax(-1)).sum(-1)
