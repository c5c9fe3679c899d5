"""How a :class:`BoxNetwork` learns: heat maps round the centres of faces in whole pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn.functional import l1_loss, logsigmoid
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.data import DataLoader, Dataset

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.checkpoints import checkpoint_key, read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.landmarks.images.box_network import STRIDE, BoxNetwork, FaceMaps, face_geometry
from torchface.progress import Progress, silent

_SPREAD, _LEAST_SPREAD = 0.09, 0.6  # of the heat round a centre: of the face's side, and in cells
_DESCRIBED = 0.3  # cells of so much heat describe the face
_GEOMETRY = torch.tensor([1.0, 1.0, 1.5, 0.7, 0.7])  # what an error of centre (in sides), size and angle costs


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """A picture and the faces in it.

    Args:
        image: uint8 (3,H,W), red first.
        faces: x and y of the centre, side, pixels, roll angle, radians, (F,4); see ``ibug_68.turned_box``.
        doubtful: whether a face may be found or not, (F,): hidden, cut by the border, small.

    Example:
        >>> face = torch.tensor([[60.0, 50.0, 40.0, 0.0]])  # x, y, side, roll
        >>> picture = LabelledPicture(torch.zeros(3, 100, 120, dtype=torch.uint8), face, torch.tensor([False]))
        >>> len(picture.faces)
        1
    """

    image: Tensor
    faces: Tensor
    doubtful: Tensor


class Pictures(Protocol):
    """Pictures of one size by number; the same number gives the same picture."""

    def __call__(self, number: int) -> LabelledPicture: ...


@dataclass(frozen=True)
class BoxTrainingSettings:
    """How a network of face boxes learns.

    Args:
        pictures: that it sees, none of them twice.
        batch: pictures a step.
        rate: the highest learning rate; it rises over the first steps and falls to none.
        decay: of the weights.
        averaged: steps over which the weights that are kept are averaged.
        channels, blocks: see :class:`BoxNetwork`.
        checkpoint: steps from one to the next.

    Example:
        >>> BoxTrainingSettings(pictures=1600, batch=16).steps
        100
    """

    pictures: int = 80_000
    batch: int = 16
    rate: float = 3e-3
    decay: float = 1e-4
    averaged: int = 200
    channels: tuple[int, ...] = (24, 32, 64, 96)
    blocks: tuple[int, ...] = (1, 3, 4, 4)
    checkpoint: int = 100

    def __post_init__(self) -> None:
        if min(self.pictures, self.batch, self.averaged, self.checkpoint) < 1 or not self.rate > 0:
            raise ValueRangeError(
                f"training of boxes: found {self.pictures} pictures, {self.batch} a step, rate {self.rate}, averaged "
                f"over {self.averaged}, a checkpoint every {self.checkpoint}; expected positive numbers"
            )

    @property
    def steps(self) -> int:
        """How many."""
        return -(-self.pictures // self.batch)


class _Batch(NamedTuple):
    """Images uint8 (B,3,H,W), faces (B,F,4), NaN where a picture has fewer, and which are doubtful (B,F)."""

    images: Tensor
    faces: Tensor
    doubtful: Tensor


class _Numbered(Dataset[LabelledPicture]):
    def __init__(self, pictures: Pictures, begin: int, end: int) -> None:
        self.pictures, self.begin, self.end = pictures, begin, end

    def __len__(self) -> int:
        return self.end - self.begin

    def __getitem__(self, number: int) -> LabelledPicture:
        return self.pictures(self.begin + number)


def fit_boxes(
    pictures: Pictures,
    settings: BoxTrainingSettings | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
    seed: int = 0,
    workers: int = 0,
    source: Mapping[str, object] | None = None,
) -> BoxNetwork:
    """Learns from pictures.

    Args:
        pictures: by number.
        settings: how it learns.
        progress: called with each step and how far it is.
        checkpoint: a file that is written now and then; where it is there, from the same settings, seed and source,
            learning goes on from it.
        seed: of the first weights.
        workers: processes that make pictures; this one if 0.
        source: what the pictures are made of, for the checkpoint.

    Raises:
        FileFormatError: the checkpoint is of other settings or another source.
    """
    settings, progress = settings or BoxTrainingSettings(), progress or silent
    with torch.random.fork_rng([]):
        torch.manual_seed(seed)
        model = BoxNetwork(settings.channels, settings.blocks)
    model.train().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(1 - 1 / settings.averaged), use_buffers=True)
    optimiser = torch.optim.AdamW(model.parameters(), settings.rate, weight_decay=settings.decay)
    key = content_key("box_training/1", settings=settings, seed=seed, source=source or {})
    step = 0 if checkpoint is None else _resume(checkpoint, key, model, average, optimiser)
    loader = DataLoader(
        _Numbered(pictures, step * settings.batch, settings.steps * settings.batch),
        settings.batch,
        collate_fn=_collate,
        num_workers=workers,
    )
    recent = math.nan
    for batch in loader:  # a step of gradient descent each
        for group in optimiser.param_groups:
            group["lr"] = settings.rate * _share_of_rate(step, settings.steps)
        images = (batch.images.float() / 255).to(memory_format=torch.channels_last)
        loss = box_loss(model.maps(images), batch.faces, batch.doubtful)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 5.0)
        optimiser.step()
        average.update_parameters(model)
        step += 1
        now = float(loss.detach())
        recent = now if math.isnan(recent) else 0.98 * recent + 0.02 * now
        progress(f"learning, loss {recent:.3f}", step, settings.steps)
        if checkpoint is not None and step % settings.checkpoint == 0 and step < settings.steps:
            write_checkpoint(checkpoint, _state(step, model, average, optimiser), key)
    found = average.module
    assert isinstance(found, BoxNetwork)
    return found.to(memory_format=torch.contiguous_format).eval()  # type: ignore[call-overload]


def box_loss(maps: FaceMaps, faces: Tensor, doubtful: Tensor) -> Tensor:
    """Focal loss of the centres, L1 distance of the geometry; one number.

    Cells of doubtful faces count neither way.

    Args:
        maps: of B images.
        faces: centre, side, roll angle, (B,F,4), NaN for none.
        doubtful: (B,F).

    Source: Law and Deng 2018; Zhou, Wang, Krähenbühl 2019.
    """
    height, width = maps.centre.shape[-2:]
    there = torch.isfinite(faces).all(-1)
    sure = there & ~doubtful
    middle = (faces[..., :2].nan_to_num(-1e4) + 0.5) / STRIDE - 0.5
    side = faces[..., 2].nan_to_num(1.0) / STRIDE
    x, y = torch.arange(width).to(side), torch.arange(height).to(side)
    cell = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)  # (h,w,2)
    at = middle.round()  # the cell that is the face's own
    squared = (cell - at[:, :, None, None]).square().sum(-1)  # (B,F,h,w)
    spread = (_SPREAD * side).clamp(min=_LEAST_SPREAD)[..., None, None]
    heat = torch.exp(-squared / (2 * spread.square())) * sure[..., None, None]
    best, owner = heat.amax(1), heat.argmax(1)  # (B,h,w)
    own = (squared < 0.25).logical_and(sure[..., None, None]).any(1)
    reach = (cell - middle[:, :, None, None]).abs().amax(-1) < 0.6 * side[..., None, None]
    unknown = (reach & (there & doubtful)[..., None, None]).any(1)
    counted = own | (~unknown)
    logit = maps.centre[:, 0]
    likely = logit.sigmoid()
    positive = -(1 - likely).square() * logsigmoid(logit)
    negative = -((1 - best) ** 4) * likely.square() * logsigmoid(-logit)
    count = own.sum().clamp(min=1)
    centre = torch.where(own, positive, negative)[counted].sum() / count
    described = (best > _DESCRIBED) & ~(unknown & ~own)
    image, row, column = described.nonzero(as_tuple=True)
    chosen = faces[image, owner[image, row, column]]
    wanted = face_geometry(chosen, cell[row, column])
    said = maps.geometry.permute(0, 2, 3, 1)[image, row, column]
    unit = torch.ones_like(said)
    unit[:, :2] = (STRIDE / chosen[:, 2:3]).expand(-1, 2)  # cells to sides
    unit = unit * _GEOMETRY.to(said) * best[image, row, column, None]
    weight = best[image, row, column].sum().clamp(min=1)
    return centre + 2.0 * l1_loss(said * unit, wanted * unit, reduction="sum") / weight


def _share_of_rate(step: int, steps: int) -> float:
    """Of the highest learning rate: up over the first twentieth, down along a cosine."""
    rising = max(1.0, steps / 20)
    if step < rising:
        return (step + 1) / (rising + 1)
    return 0.5 * (1 + math.cos(math.pi * (step - rising) / max(1.0, steps - rising)))


def _collate(pictures: Sequence[LabelledPicture]) -> _Batch:
    most = max(1, *(len(one.faces) for one in pictures))
    faces = torch.full((len(pictures), most, 4), torch.nan)
    doubtful = torch.zeros(len(pictures), most, dtype=torch.bool)
    for row, one in enumerate(pictures):  # each has as many faces as it has
        faces[row, : len(one.faces)] = one.faces
        doubtful[row, : len(one.faces)] = one.doubtful
    return _Batch(torch.stack([one.image for one in pictures]), faces, doubtful)


def _state(step: int, model: nn.Module, average: AveragedModel, optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """All that goes on changing, by name."""
    state = {"step": torch.tensor(step)}
    state |= {f"model.{name}": value.clone() for name, value in model.state_dict().items()}
    state |= {f"average.{name}": value.clone() for name, value in average.state_dict().items()}
    for number, moments in optimiser.state_dict()["state"].items():
        state |= {f"optimiser.{number}.{name}": value.clone() for name, value in moments.items()}
    return state


def _resume(path: Path, key: str, model: nn.Module, average: AveragedModel, optimiser: torch.optim.Optimizer) -> int:
    """The step that a checkpoint was written after, 0 for none; model, average and optimiser as they were then."""
    if checkpoint_key(path) not in (None, key):
        raise FileFormatError(
            f"{path}: found a checkpoint of other pictures or settings, or of another version; expected one of these; "
            "remove it to start anew"
        )
    state = read_checkpoint(path, key)
    if state is None:
        return 0
    model.load_state_dict({name[6:]: value for name, value in state.items() if name.startswith("model.")})
    average.load_state_dict({name[8:]: value for name, value in state.items() if name.startswith("average.")})
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in state.items():
        if name.startswith("optimiser."):
            _, number, moment = name.split(".")
            moments.setdefault(int(number), {})[moment] = value
    optimiser.load_state_dict({"state": moments, "param_groups": optimiser.state_dict()["param_groups"]})
    return int(state["step"])
