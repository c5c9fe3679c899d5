"""A small convolutional network that finds faces at every roll angle: a heat map of centres, sizes and angles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import as_real
from torchface.progress import Progress, ValueLog, silent

if TYPE_CHECKING:
    from torchface.landmarks.images.boxes.box_training import BoxTrainingSettings, Pictures

INPUT_SIZE = 896
"""Pixels of the longer side of the copy of an image that the network is given; a face of 32 pixels in 1280 has 22."""

COPIES = 5  # copies of an image that the network sees: each half as large as the one before, for faces twice as large
STRIDE = 8  # pixels a cell of the maps
TYPICAL_SIDE = 24.0  # pixels: what a network that has learned nothing takes a face for

_SMALLEST = 64  # pixels a side of an image
_FEWEST_CELLS = (_SMALLEST // STRIDE) ** 2
LOG_SIDES = 5.0  # how far the logarithm of a side may lie from the typical one's
BESIDE_A_PEAK = 1e-3  # what a score counts beside a likelier one of the same face

_SAME_FACE = 0.45  # of the larger side: two faces whose centres are nearer are one


class FaceMaps(NamedTuple):
    """What the network says of every cell."""

    centre: Tensor  # logit that a face has its centre in the cell, (B,1,h,w)
    # Of that face (B,5,h,w): its centre against the cell's, x and y in cells; the logarithm of its side over 24 pixels;
    # cosine and sine of its roll angle, of any length.
    geometry: Tensor


class BoxNetwork(nn.Module):
    """Face boxes of every size and roll angle in colour images, in one pass.

    Depthwise separable convolutions at strides 4, 8, 16 and 32; what the coarse levels see is added to the level of
    stride 8, whose cells say whether a face has its centre there, how large it is and how far it is turned. The same
    is asked of copies of half the size, a quarter, and so on: the network needs to know faces of a range of three in
    size alone. Of all that is said of one face the likeliest counts.

    Args:
        channels: of the four levels.
        blocks: convolutions of the four levels.
        faces: found at most, K.

    Raises:
        ValueRangeError: not four levels, or a number below 1.

    Source: Zhou, Wang, Krähenbühl 2019 (centres as points); Howard et al. 2017 (separable convolutions).

    Example:
        >>> from torchface import zoo
        >>> network = zoo.get_model("face_boxes")
        >>> with torch.no_grad():
        ...     faces = network(torch.full((1, 3, 128, 128), 0.5))
        >>> bool(faces[..., 3].max() < 0.4)  # no score says that grey is a face
        True
    """

    def __init__(
        self, channels: Sequence[int] = (24, 48, 64, 64), blocks: Sequence[int] = (1, 4, 3, 1), faces: int = 32
    ) -> None:
        super().__init__()
        numbers = (*channels, *blocks)
        fit = len(channels) == len(blocks) == 4 and 0 < faces <= _FEWEST_CELLS
        if not fit or not all(0 < one <= 1024 for one in numbers):
            raise ValueRangeError(
                f"BoxNetwork: found channels {list(channels)}, blocks {list(blocks)}, faces {faces}; expected four "
                f"numbers each from 1 to 1024, and from 1 to {_FEWEST_CELLS} faces"
            )
        self.channels, self.blocks, self.faces = tuple(channels), tuple(blocks), faces
        first, second, third, fourth = self.channels
        self.stem = nn.Sequential(_convolution(3, first, 4, 4), nn.ReLU())
        self.level_4 = nn.Sequential(*[SeparableConvolution(first, first, 3) for _ in range(blocks[0])])
        self.level_8 = _level(first, second, blocks[1], 3)
        self.level_16 = _level(second, third, blocks[2], 5)
        self.level_32 = _level(third, fourth, blocks[3], 5)
        self.from_32 = _convolution(fourth, third, 1)
        self.mixed_16 = SeparableConvolution(third, third, 5)
        self.from_16 = _convolution(third, second, 1)
        self.mixed_8 = nn.Sequential(
            SeparableConvolution(second, second, 3), SeparableConvolution(second, 2 * second, 3)
        )
        self.said = nn.Conv2d(2 * second, 6, 1)
        assert self.said.bias is not None
        with torch.no_grad():
            self.said.weight.mul_(0.1)
            self.said.bias.copy_(torch.tensor([-4.6, 0, 0, 0, 0.5, 0]))  # a cell in a hundred; upright

    @classmethod
    def fit(
        cls,
        pictures: Pictures,
        settings: BoxTrainingSettings | None = None,
        progress: Progress | None = None,
        checkpoint: Path | None = None,
        source: Mapping[str, object] | None = None,
        device: str | torch.device = "cpu",
        log: ValueLog | None = None,
        start: BoxNetwork | None = None,
    ) -> BoxNetwork:
        """Learns from pictures.

        Args:
            pictures: by number.
            settings: how it learns.
            progress: called with each step and how far it is.
            checkpoint: a file that is written now and then; where it is there, from the same settings and source,
                learning goes on from it.
            source: what the pictures are made of, for the checkpoint.
            device: where the network computes.
            log: called with what was measured, every fifty steps.
            start: a network of the settings' channels and blocks that goes on learning; an untaught one if absent.

        Raises:
            FileFormatError: the checkpoint is of other settings or another source.
        """
        from torchface.landmarks.images.boxes.box_training import fit_boxes
        from torchface.optim import DescentRun

        return fit_boxes(pictures, settings, DescentRun(progress or silent, log, checkpoint, device), source, start)

    @property
    def config(self) -> dict[str, Any]:
        """What it is built from."""
        return {"channels": list(self.channels), "blocks": list(self.blocks), "faces": self.faces}

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> BoxNetwork:
        """A network that has learned nothing yet."""
        return cls(**config)

    def maps(self, images: Tensor) -> FaceMaps:
        """What is said of every cell of images (B,3,H,W) in [0,1]; h and w are an eighth of H and W."""
        fine = self.level_8(self.level_4(self.stem(images - 0.5)))
        middle = self.level_16(fine)
        coarse = self.from_32(self.level_32(middle))
        middle = self.mixed_16(torch.relu(middle + interpolate(coarse, size=middle.shape[-2:])))
        fine = torch.relu(fine + interpolate(self.from_16(middle), size=fine.shape[-2:]))
        said = self.said(self.mixed_8(fine))
        return FaceMaps(said[:, :1], said[:, 1:])

    def cells(self, images: Tensor) -> Tensor:
        """The face of every cell (B,h*w,6), in pixels of the images, as :meth:`forward` gives faces."""
        return _said_faces(self.maps(images))

    def forward(self, images: Tensor) -> Tensor:
        """The likeliest faces, (B,K,6): x and y of the centre, side, score in [0,1], cosine and sine of the roll angle.

        Pixels of the images, whose centres are at integers; the angle is clockwise as the image is seen, and the side
        that of the box round the face turned upright. The likeliest come first; what is no face has a score near 0.

        Args:
            images: red, green, blue in [0,1], (B,3,H,W), 64 pixels a side at least.

        Raises:
            ShapeError: no such images.
        """
        _check_images(images)
        copies = [as_real(images)]
        for _ in range(COPIES - 1):
            copies.append(avg_pool2d(copies[-1], 2))
        return self.likeliest(torch.cat([enlarged(self.cells(copy), 2**half) for half, copy in enumerate(copies)], 1))

    def likeliest(self, cells: Tensor) -> Tensor:
        """The likeliest of the faces (B,N,6) of all cells, as :meth:`forward` gives them."""
        rows = cells[..., 3].topk(self.faces, dim=1).indices
        faces = cells.gather(1, rows[..., None].expand(-1, -1, 6))
        apart = (faces[:, :, None, :2] - faces[:, None, :, :2]).square().sum(-1).sqrt()
        near = apart < _SAME_FACE * torch.maximum(faces[:, :, None, 2], faces[:, None, :, 2])
        known = near.logical_and(faces.new_ones(self.faces, self.faces).tril(-1) > 0).any(2)  # by a likelier row
        scores = faces[..., 3] * torch.where(known, BESIDE_A_PEAK, 1.0)
        scores, rows = scores.topk(self.faces, dim=1)
        faces = faces.gather(1, rows[..., None].expand(-1, -1, 6))
        return torch.cat([faces[..., :3], scores[..., None], faces[..., 4:]], -1)


def enlarged(faces: Tensor, scale: int) -> Tensor:
    """Faces (...,6) in pixels of a picture that is larger by a scale."""
    return faces * faces.new_tensor([scale] * 3 + [1] * 3) + faces.new_tensor([(scale - 1) / 2] * 2 + [0] * 4)


def _said_faces(maps: FaceMaps) -> Tensor:
    likely, geometry = maps.centre.sigmoid(), maps.geometry
    # Cells beside a peak keep a thousandth: among equal ones the order would be anybody's.
    peaks = likely * torch.where(max_pool2d(likely, 3, 1, 1) == likely, 1.0, BESIDE_A_PEAK)
    column = geometry[:, :1] + torch.arange(peaks.shape[3]).to(peaks)
    row = geometry[:, 1:2] + torch.arange(peaks.shape[2]).to(peaks)[:, None]
    middle = STRIDE * (torch.cat([column, row], 1) + 0.5) - 0.5
    side = TYPICAL_SIDE * geometry[:, 2:3].clamp(-LOG_SIDES, LOG_SIDES).exp()
    angle = geometry[:, 3:] / geometry[:, 3:].square().sum(1, keepdim=True).clamp(min=1e-12).sqrt()
    return torch.cat([middle, side, peaks, angle], 1).flatten(2).transpose(1, 2)


def face_geometry(faces: Tensor, cells: Tensor) -> Tensor:
    """What maps say of faces (...,4), x and y, side, roll angle, in cells (...,2): the (...,5) of :class:`FaceMaps`."""
    middle = (faces[..., :2] + 0.5) / STRIDE - 0.5 - cells
    side = (faces[..., 2:3] / TYPICAL_SIDE).log()
    return torch.cat([middle, side, faces[..., 3:].cos(), faces[..., 3:].sin()], -1)


class SeparableConvolution(nn.Module):
    """A depthwise and a pointwise convolution, with a shortcut where the form stays."""

    def __init__(self, inside: int, outside: int, size: int, stride: int = 1) -> None:
        super().__init__()
        self.depthwise = _convolution(inside, inside, size, stride, inside)
        self.pointwise = _convolution(inside, outside, 1)
        self.shortcut = inside == outside and stride == 1

    def forward(self, values: Tensor) -> Tensor:
        """(B,C,h,w)."""
        changed = self.pointwise(self.depthwise(values))
        return torch.relu(values + changed if self.shortcut else changed)


def _level(inside: int, outside: int, count: int, size: int) -> nn.Sequential:
    """Half the resolution, then as many convolutions in all."""
    first = SeparableConvolution(inside, outside, size, 2)
    return nn.Sequential(first, *[SeparableConvolution(outside, outside, size) for _ in range(count - 1)])


def _convolution(inside: int, outside: int, size: int, stride: int = 1, groups: int = 1) -> nn.Sequential:
    padding = size // 2 if size % 2 else 0
    convolution = nn.Conv2d(inside, outside, size, stride, padding, groups=groups, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outside))


def _check_images(images: Tensor) -> None:
    if images.ndim != 4 or images.shape[1] != 3 or min(images.shape[2:]) < _SMALLEST:
        raise ShapeError(f"images: found {tuple(images.shape)}, expected (B,3,H,W), {_SMALLEST} pixels a side at least")
