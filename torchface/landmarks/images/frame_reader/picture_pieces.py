"""Pieces of a picture: a turned square of it, and the whole made smaller."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, pad

from torchface.landmarks.images.frame_reader.face_place import axes

_MULTIPLE = 32  # what a network's coarsest level asks for
AROUND = 2.0  # pixels that interpolation needs beyond points


def picture_size(image: Tensor) -> Tensor:
    """Width and height of a picture (H,W,C), (2,)."""
    return torch.stack([torch.full((), image.shape[axis], dtype=torch.float32) for axis in (1, 0)])


def sampled(image: Tensor, points: Tensor, spacing: Tensor, beyond: Tensor) -> Tensor:
    """A picture's colours (3,P) in [0,1] at points, ``spacing`` apart, between its pixels; the border's go on beyond
    it.

    Where the points are further apart than pixels, whole pixels are averaged first, and ``beyond`` the points.
    """
    last = picture_size(image) - 1
    low = (points.amin(0) - beyond).clamp(min=0).minimum(last).floor()
    extent = (points.amax(0) + beyond).clamp(min=0).minimum(last).ceil() - low + 1
    step = spacing.round().clamp(min=1).minimum(extent.amin(0))
    count = (extent / step).floor()
    left, top, columns, rows, by = whole_numbers(torch.cat([low, count, step[None]]))
    for start, length, axis in ((top, rows * by, 0), (left, columns * by, 1)):
        torch._check(start + length >= 0)
        torch._check(start + length <= image.shape[axis])
    piece = image.narrow(0, top, rows * by).narrow(1, left, columns * by)
    planes = piece.permute(2, 0, 1)[:3].float()  # to cut the last axis takes long
    # Rows first: most pixels are gone when the columns' turn comes.
    planes = planes.reshape(3, rows, by, columns * by).mean(2).reshape(3, rows, columns, by).mean(3)
    scale = 2 / (count * step)
    places = torch.addmm((0.5 - low) * scale - 1, points, scale.diag())  # one product in place of five steps
    found = grid_sample(planes[None], places[None, None], padding_mode="border", align_corners=False)
    return found[0, :, 0] / 255


def whole_numbers(values: Tensor) -> list[int]:
    """Numbers (P,) that are whole and not negative; in an exported graph they are sizes known when it runs."""
    numbers = [one.item() for one in values.long().unbind()]
    for number in numbers:
        torch._check(number >= 0)
    return numbers  # type: ignore[return-value]


def cut_square(image: Tensor, place: Tensor, size: int, margin: float) -> Tensor:
    """As :func:`~torchface.landmarks.images.face_crop.cut_crop`: the square (1,3,S,S) in [0,1] of a picture uint8
    (H,W,C) round a face (5,), upright, ``margin`` times the place's side, as a network takes it."""
    spacing = place[2] * (margin / size)
    points = torch.addmm(place[:2], crop_grid(size, size), spacing * axes(place))
    beyond = spacing * place[3:].abs().sum() / 2 + AROUND
    return sampled(image, points, spacing, beyond).view(1, 3, size, size)


def crop_grid(width: int, height: int) -> Tensor:
    """Pixels of a crop beside its middle, (height * width,2)."""
    across, down = (torch.arange(count).float() - (count - 1) / 2 for count in (width, height))
    return torch.stack(torch.meshgrid(across, down, indexing="xy"), -1).reshape(-1, 2)


def from_square(points: Tensor, place: Tensor, size: int, margin: float) -> Tensor:
    """Points (P,2) of the copy that :func:`cut_square` makes, in the picture."""
    return (points - (size - 1) / 2) * (place[2] * (margin / size)) @ axes(place) + place[:2]


def whole_picture(image: Tensor, longest: int | Tensor) -> tuple[Tensor, Tensor]:
    """A picture (1,3,h,w) in [0,1] made smaller until its longer side has so many pixels, multiples of 32, the last
    rows and columns repeated; and what to multiply its pixels by, (2,).

    Halved before by interpolation where it is more than twice as large, so that few pixels are skipped.
    """
    size = picture_size(image)
    target = (size * (longest / size.amax(0)).clamp(max=1)).round().clamp(min=1)
    planes = image.permute(2, 0, 1)[None, :3]
    for wanted in (size.minimum(2 * target), target):
        width, height = whole_numbers(wanted)
        planes = interpolate(planes, size=(height, width), mode="bilinear")
    beyond: list[int] = []
    for blocks, side in zip(whole_numbers((target / _MULTIPLE).ceil().clamp(min=2)), (width, height), strict=True):
        torch._check(blocks >= 2)
        torch._check(blocks * _MULTIPLE - side >= 0)
        beyond += [0, blocks * _MULTIPLE - side]
    return pad(planes.float() / 255, beyond, mode="replicate"), size / target
