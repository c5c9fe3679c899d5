"""Training of a :class:`BoxNetwork`: heat maps round the centres of faces in whole pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn.functional import l1_loss, logsigmoid

from torchface.files.content_keys import content_key
from torchface.landmarks.images.boxes.box_network import STRIDE, BoxNetwork, FaceMaps, face_geometry
from torchface.optim import DescentRun, DescentSettings, DescentTask, descend

_SPREAD, _LEAST_SPREAD = 0.09, 0.8  # of the heat round a centre: of the face's side, and in cells
_DESCRIBED = 0.3  # cells of so much heat describe the face
_GEOMETRY = torch.tensor([1.0, 1.0, 1.5, 0.7, 0.7])  # what an error of centre (in sides), size and angle costs


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """A picture and the faces in it.

    Args:
        image: uint8 (3,H,W), red first.
        faces: x and y of the centre, side, pixels, roll angle, radians, (F,4); see ``ibug_68.turned_box``.
        uncertain: whether a face may be found or not, (F,): hidden, cut by the border, small.

    Example:
        >>> face = torch.tensor([[60.0, 50.0, 40.0, 0.0]])  # x, y, side, roll
        >>> picture = LabelledPicture(torch.zeros(3, 100, 120, dtype=torch.uint8), face, torch.tensor([False]))
        >>> len(picture.faces)
        1
    """

    image: Tensor
    faces: Tensor
    uncertain: Tensor


class Pictures(Protocol):
    """Pictures of one size by number; the same number gives the same picture."""

    def __call__(self, number: int) -> LabelledPicture: ...


@dataclass(frozen=True)
class BoxTrainingSettings(DescentSettings):
    """How a network of face boxes learns; see :class:`~torchface.optim.DescentSettings` for the rest.

    Args:
        channels, blocks: see :class:`BoxNetwork`.

    Example:
        >>> BoxTrainingSettings(steps=100).batch
        32
    """

    steps: int = 12_500
    batch: int = 32
    rate: float = 3e-3
    average: float = 0.995
    channels: tuple[int, ...] = (24, 48, 64, 64)
    blocks: tuple[int, ...] = (1, 4, 3, 1)


class _Batch(NamedTuple):
    """Images uint8 (B,3,H,W), faces (B,F,4), NaN where a picture has fewer, and which are uncertain (B,F)."""

    images: Tensor
    faces: Tensor
    uncertain: Tensor


def fit_boxes(
    pictures: Pictures,
    settings: BoxTrainingSettings | None,
    run: DescentRun,
    source: Mapping[str, object] | None,
    start: BoxNetwork | None,
) -> BoxNetwork:
    """See :meth:`BoxNetwork.fit`."""
    settings, device = settings or BoxTrainingSettings(), run.device
    with torch.random.fork_rng([]):  # the first weights alone
        torch.manual_seed(settings.seed)
        model = BoxNetwork(settings.channels, settings.blocks)
    if start is not None:
        model.load_state_dict(start.state_dict())

    def loss(batch: _Batch, _: float) -> tuple[Tensor, float]:
        images = (batch.images.to(device).float() / 255).to(memory_format=torch.channels_last)
        value = box_loss(model.maps(images), batch.faces.to(device), batch.uncertain.to(device))
        return value, float(value.detach())

    key = content_key("box_training/3", config=model.config, source=source or {})
    task = DescentTask(partial(_drawn, pictures, settings.batch), loss, key)
    return descend(model, task, settings, run)


def _drawn(pictures: Pictures, size: int, step: int) -> _Batch:
    return _collate([pictures(number) for number in range(step * size, (step + 1) * size)])


def box_loss(maps: FaceMaps, faces: Tensor, uncertain: Tensor) -> Tensor:
    """Focal loss of the centres, L1 distance of the geometry; one number.

    Cells of uncertain faces count neither way.

    Args:
        faces: centre, side, roll angle, (B,F,4), NaN for none.

    Source: Law and Deng 2018; Zhou, Wang, Krähenbühl 2019.
    """
    height, width = maps.centre.shape[-2:]
    there = torch.isfinite(faces).all(-1)
    sure = there & ~uncertain
    middle = (faces[..., :2].nan_to_num(-1e4) + 0.5) / STRIDE - 0.5
    side = faces[..., 2].nan_to_num(1.0) / STRIDE
    x, y = torch.arange(width).to(side), torch.arange(height).to(side)
    cell = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)  # (h,w,2)
    at = middle.round()  # the cell that is the face's own
    squared = (cell - at[:, :, None, None]).square().sum(-1)  # (B,F,h,w)
    spread = (_SPREAD * side).clamp(min=_LEAST_SPREAD)[..., None, None]
    heat = torch.exp(-squared / (2 * spread.square())) * sure[..., None, None]
    best, owner = heat.amax(1), heat.argmax(1)  # (B,h,w)
    centred = (squared < 0.25).logical_and(sure[..., None, None]).any(1)
    reach = (cell - middle[:, :, None, None]).abs().amax(-1) < 0.6 * side[..., None, None]
    unknown = (reach & (there & uncertain)[..., None, None]).any(1)
    counted = centred | (~unknown)
    logit = maps.centre[:, 0]
    likely = logit.sigmoid()
    positive = -(1 - likely).square() * logsigmoid(logit)
    negative = -((1 - best) ** 4) * likely.square() * logsigmoid(-logit)
    count = centred.sum().clamp(min=1)
    centre = torch.where(centred, positive, negative)[counted].sum() / count
    described = (best > _DESCRIBED) & ~(unknown & ~centred)
    image, row, column = described.nonzero(as_tuple=True)
    chosen = faces[image, owner[image, row, column]]
    wanted = face_geometry(chosen, cell[row, column])
    said = maps.geometry.permute(0, 2, 3, 1)[image, row, column]
    unit = torch.ones_like(said)
    unit[:, :2] = (STRIDE / chosen[:, 2:3]).expand(-1, 2)  # cells to sides
    unit = unit * _GEOMETRY.to(said) * best[image, row, column, None]
    weight = best[image, row, column].sum().clamp(min=1)
    return centre + 2.0 * l1_loss(said * unit, wanted * unit, reduction="sum") / weight


def _collate(pictures: Sequence[LabelledPicture]) -> _Batch:
    most = max(1, *(len(one.faces) for one in pictures))
    faces = torch.full((len(pictures), most, 4), torch.nan)
    uncertain = torch.zeros(len(pictures), most, dtype=torch.bool)
    for row, one in enumerate(pictures):  # each has as many faces as it has
        faces[row, : len(one.faces)] = one.faces
        uncertain[row, : len(one.faces)] = one.uncertain
    return _Batch(torch.stack([one.image for one in pictures]), faces, uncertain)
