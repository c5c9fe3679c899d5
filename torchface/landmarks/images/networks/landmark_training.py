"""Training of the landmark network on cut-out pictures with exact landmarks."""

from dataclasses import dataclass, field, fields
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, smooth_l1_loss
from torch.utils.data import Dataset

from torchface.errors import ValueRangeError
from torchface.files.content_keys import content_key
from torchface.landmarks.images.ibug_68 import COUNT, MIRROR_68
from torchface.landmarks.images.networks.dense_head import DenseHead, DenseReading, in_face_frame
from torchface.landmarks.images.networks.heat_map_training import (
    check_pictures,
    deviation_loss,
    draw_numbers,
    gap_loss,
    heat_loss,
    point_loss,
)
from torchface.landmarks.images.networks.landmark_network import STRIDE, LandmarkNetwork
from torchface.landmarks.images.networks.picture_augmentation import AugmentationSettings, Crops, augmented
from torchface.optim import DescentSettings, DescentTask
from torchface.shape_names import ARKIT, mirror

_METHOD = "landmark network/4"
# Pairs of landmarks whose distance is what is read off a face: how far lids and lips are open, how high brows are.
_PAIRS = torch.tensor([[37, 41], [38, 40], [43, 47], [44, 46], [61, 67], [62, 66], [63, 65], [51, 57], [48, 54],
                       [19, 37], [24, 44]])  # fmt: skip
_OPENINGS = ((0, 1), (2, 3), (4, 5, 6), (7,), (8,), (9,), (10,))
"""Rows of ``_PAIRS`` whose mean length is an opening: lids, lips inside and outside, the mouth's width, brows."""
_HEAT = 1.0  # standard deviation of the heat map asked for, cells
_OPENING, _SLOPE, _VARIED = 10.0, 10.0, 0.02  # weights of an opening's error and slope; squares that make a slope
_STARTED, _RIDGE = 1024, 1e-2  # pictures, and share of their number
_APART = 16  # steps from one time that a crop is shown to the next


@dataclass(frozen=True)
class NetworkSettings(DescentSettings):
    """How a landmark network is trained.

    Args:
        pair: weight of distances between landmarks, such as between lids.
        opening: weight of openings, and of their slope over the true ones in each batch, which is to be 1.
        heat: weight of the heat maps' form, which fades over the first half; 0 for a network that has learned it.
        dense: weight of the points beside the 68, where the network has some.
        expression: weight of the likelihood of blendshape weights, likewise.
        bfloat16: share of the steps, the first, whose convolutions compute in bfloat16: twice as fast on processors
            that have it.
        shown: in how many steps each crop is shown: drawing one takes as long as learning from it. A divisor of
            ``batch``.
        augmentation: how widely crops are drawn.

    Example:
        >>> NetworkSettings().steps * NetworkSettings().batch  # crops that a network sees
        512000
    """

    workers: int = 1
    pair: float = 1.0
    opening: float = 1.0
    heat: float = 0.5
    dense: float = 1.0
    expression: float = 2.0
    bfloat16: float = 0.0
    shown: int = 1
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shown < 1 or self.batch % self.shown:
            raise ValueRangeError(f"shown: found {self.shown}, expected a divisor of the batch's {self.batch} crops")


def landmark_task(
    network: LandmarkNetwork,
    pictures: Dataset[tuple[Tensor, ...]],
    settings: NetworkSettings,
    device: str | torch.device,
) -> DescentTask[tuple[Crops, Tensor]]:
    """What a network learns of pictures; see :class:`LandmarkNetwork`."""
    expected, shapes = "uint8 (4,H,W), landmarks (68,2) and visibility (68,)", [(68, 2), (68,)]
    if network.points:
        expected += f", points ({network.points},2), their visibility, and weights ({len(ARKIT)},)"
        shapes += [(network.points, 2), (network.points,), (len(ARKIT),)]
    check_pictures(pictures, expected, *shapes)
    if network.dense is not None and not network.dense.started:
        _start_points(network.dense, pictures)
    names = ("pair", "opening", "heat", "dense", "expression", "bfloat16", "shown", "augmentation")
    learned = {name: getattr(settings, name) for name in names}
    return DescentTask(
        _Drawn(pictures, network.size, network.margin, network.mirror, settings),
        partial(_loss, network, settings, device),
        content_key(_METHOD, settings=learned, config=network.config),
        "training the network",
        "pixels off",
    )


@torch.no_grad()
def _start_points(head: DenseHead, pictures: Dataset[tuple[Tensor, ...]]) -> None:
    """Has a head begin with the linear map from the 68 to its points that fits pictures best."""
    count: int = len(pictures)  # type: ignore[arg-type]
    _, landmarks, _, points, *_ = pictures[torch.linspace(0, count - 1, min(count, _STARTED)).long()]
    flip = landmarks.new_tensor([-1.0, 1.0])  # both sides of each face
    landmarks = torch.cat([landmarks, landmarks[:, list(MIRROR_68)] * flip])
    points = torch.cat([points, points[:, head.mirror] * flip])
    own, base = (in_face_frame(one, landmarks).flatten(1) for one in (landmarks, points))
    mean, about = own.mean(0), own - own.mean(0)
    normal = about.T @ about + _RIDGE * len(own) * torch.eye(own.shape[1])
    head.start_form(torch.linalg.solve(normal, about.T @ (base - base.mean(0))).T, base.mean(0), mean)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Crops of a step, and the weights (B,52) that they show; none (B,0) for a network of the 68 alone."""

    pictures: Dataset[tuple[Tensor, ...]]
    size: int
    margin: float
    mirrored: Tensor
    settings: NetworkSettings
    kept: dict[int, tuple[Crops, Tensor]] = field(default_factory=dict)

    def __call__(self, step: int) -> tuple[Crops, Tensor]:
        steps = [step - _APART * again for again in range(self.settings.shown)]
        for number in [one for one in self.kept if one < steps[-1]]:
            del self.kept[number]
        for number in set(steps) - self.kept.keys():
            self.kept[number] = self._fresh(number)
        crops, weights = zip(*(self.kept[one] for one in steps), strict=True)
        return Crops(*(torch.cat([getattr(one, part.name) for one in crops]) for part in fields(Crops))), torch.cat(
            weights
        )

    def _fresh(self, step: int) -> tuple[Crops, Tensor]:
        numbers, generator = draw_numbers(self.pictures, self.settings, step)
        numbers = numbers[: self.settings.batch // self.settings.shown]
        how = self.size, self.margin, self.mirrored, generator, self.settings.augmentation
        return cropped(self.pictures[numbers], *how)


def cropped(
    pictures: tuple[Tensor, ...],
    size: int,
    margin: float,
    mirrored: Tensor,
    generator: torch.Generator,
    settings: AugmentationSettings,
) -> tuple[Crops, Tensor]:
    """Crops of pictures as a data set gives them, and the weights (B,52) that they show; (B,0) without points."""
    rgba, landmarks, visible, *more = pictures
    if not len(mirrored):
        return augmented(rgba, landmarks, visible, size, margin, generator, settings), landmarks[:, :0, 0]
    points, point_visible, weights = more
    marks, seen = torch.cat([landmarks, points], 1), torch.cat([visible, point_visible], 1)
    crops = augmented(rgba, marks, seen, size, margin, generator, settings, mirrored)
    return crops, torch.where(crops.mirrored[:, None], weights[:, mirror(ARKIT)], weights)


def _loss(
    network: LandmarkNetwork,
    settings: NetworkSettings,
    device: str | torch.device,
    batch: tuple[Crops, Tensor],
    share: float,
) -> tuple[Tensor, float]:
    """The loss of a batch, and the mean distance of what can be seen of the 68, pixels."""
    crops, weights = batch
    images, marks = crops.images.to(device, memory_format=torch.channels_last), crops.landmarks.to(device)
    seen, present, weights = crops.visible.to(device), crops.present.to(device), weights.to(device)
    within = ((marks > 1) & (marks < network.size - 2)).all(-1).float() * present[:, None]
    trusted = within * (0.4 + 0.6 * seen)
    truth, visible, weight = marks[:, :COUNT], seen[:, :COUNT], trusted[:, :COUNT]
    with torch.autocast(images.device.type, torch.bfloat16, enabled=share < settings.bfloat16):
        maps = network.maps(images)
    heat, features, deep = (one.float() for one in maps)  # places are read to a part of a pixel
    reading, dense = network.readings(heat, features, deep)
    places, distance = point_loss(reading.landmarks, truth, reading.deviation, weight)
    pairs = gap_loss(reading.landmarks, truth, weight, _PAIRS, 2)
    hidden = binary_cross_entropy(reading.visibility.clamp(1e-5, 1 - 1e-5), visible, reduction="none")
    hidden = (hidden * within[:, :COUNT]).sum() / weight.sum().clamp(min=1)
    absent = binary_cross_entropy(reading.presence.clamp(1e-5, 1 - 1e-5), present)
    loss = places + settings.pair * pairs + hidden + absent
    if settings.heat > 0:
        fading = settings.heat * max(0.0, 1 - 2 * share) + 0.05
        loss = loss + fading * heat_loss(heat, truth, weight, STRIDE, _HEAT)
    # Of faces that are not found yet openings say nothing.
    loss = loss + settings.opening * min(1.0, 4 * share) * opening_loss(reading.landmarks, truth, weight)
    if dense is not None:
        near, apart = point_loss(dense.points, marks[:, COUNT:], None, trusted[:, COUNT:])
        sure = deviation_loss(apart, dense.point_deviation, trusted[:, COUNT:])
        loss = loss + settings.dense * (near + sure) + settings.expression * weight_loss(dense, weights, present)
    clear = within[:, :COUNT] * visible
    return loss, float((distance * clear).sum() / clear.sum().clamp(min=1))


def openings(points: Tensor, face: Tensor) -> Tensor:
    """How far a ``face`` (B,68,2) is open, (B,7) of its size: lids, lips inside and outside, mouth's width, brows."""
    size = (face - face.mean(1, keepdim=True)).square().sum(-1).mean(1).clamp(min=1e-4).sqrt()
    first, second = _PAIRS.to(points.device).unbind(1)
    lengths = ((points[:, first] - points[:, second]).square().sum(-1) + 1e-6).sqrt() / size[:, None]
    return torch.stack([lengths[:, list(rows)].mean(1) for rows in _OPENINGS], 1)


def opening_loss(points: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    r"""The loss of openings o, (B,7), :math:`10 \lvert o - \hat o \rvert + 5 (1 - \text{slope})^2`.

    What is uncertain is drawn toward its mean where distances alone are learned: so the slope of what is read over
    what is true, in each batch, is to be 1.
    """
    read, true = openings(points, truth), openings(truth, truth)
    both = weight[:, _PAIRS].amin(-1)
    share = torch.stack([both[:, list(rows)].amin(1) for rows in _OPENINGS], 1)
    total = share.sum(0).clamp(min=1e-3)
    off = ((read - true).abs() * share).sum(0) / total
    about = true - (true * share).sum(0) / total
    varied = (about.square() * share).sum(0)
    slope = (about * read * share).sum(0) / varied.clamp(min=1e-3)
    return (
        _OPENING * off.mean()
        + _SLOPE * (smooth_l1_loss(slope, torch.ones_like(slope), reduction="none") * (varied > _VARIED)).mean()
    )


def weight_loss(dense: DenseReading, weights: Tensor, present: Tensor) -> Tensor:
    r"""The Gaussian negative log likelihood of weights, each times its deviation, so that what is uncertain is learned
    too.

    Source: Seitzer et al. 2022 (half of the deviation's square as weight).
    """
    deviation = dense.expression_deviation
    likelihood = 0.5 * ((dense.expression - weights) / deviation).square() + deviation.log()
    each = (likelihood * deviation.detach()).mean(1)
    return (each * present).sum() / present.sum().clamp(min=1)
