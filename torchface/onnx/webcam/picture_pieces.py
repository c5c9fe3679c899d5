"""Pieces of a picture as values of a graph: a turned square of it, and the whole made smaller."""

from __future__ import annotations

import torch
from onnx import TensorProto
from torch import Tensor

from torchface.onnx.graph_values import Value, ValueGraph
from torchface.onnx.webcam.face_place import middle, side, turned

_MULTIPLE = 32  # what a network's coarsest level asks for
AROUND = 2.0
"""Pixels that interpolation needs beyond points."""


def picture_size(image: Value) -> Value:
    """Width and height of a picture (H,W,C), (2,)."""
    graph = image.graph
    height, width = (graph.op("Shape", image, start=axis, end=axis + 1) for axis in (0, 1))
    return graph.cat(width, height).number()


def sampled(image: Value, points: Value, spacing: Value, beyond: Value) -> Value:
    """A picture's colours at points between its pixels; beyond the border the border's pixels go on.

    Where the points are further apart than pixels, whole pixels are averaged first, so that none are skipped.

    Args:
        image: uint8 (H,W,C), red first; a fourth channel counts for nothing.
        points: (P,2), pixels, finite.
        spacing: from one point to the next, (1,) pixels.
        beyond: how far what is averaged goes on beyond the points, (1,) pixels.

    Returns:
        (3,P) in [0,1].
    """
    graph = image.graph
    last = picture_size(image) - 1.0
    low = (points.reduced("ReduceMin", 0) - beyond).most(0.0).least(last)
    low, high = graph.op("Floor", low), graph.op("Ceil", points.reduced("ReduceMax", 0) + beyond).most(0.0).least(last)
    extent = high - low + 1.0
    step = graph.op("Round", spacing).most(1.0).least(extent.reduced("ReduceMin", 0, keep=True))
    count = graph.op("Floor", extent / step)
    extent = count * step
    first, end = low.whole(), (low + extent).whole()
    # Rows first.
    starts = graph.cat(graph.op("Gather", first, [1, 0]), [0])
    ends = graph.cat(graph.op("Gather", end, [1, 0]), [3])
    piece = graph.op("Slice", image, starts, ends, [0, 1, 2])
    planes = graph.op("Transpose", piece, perm=[2, 0, 1]).number()
    by, columns = step.whole(), extent.rows(0, 1).whole()
    rows = graph.op("Reshape", planes, graph.cat([-1], by, columns)).reduced("ReduceMean", 1)
    pooled = graph.op("Reshape", rows, graph.cat([-1], by)).reduced("ReduceMean", 1)
    planes = graph.op("Reshape", pooled, graph.cat([1, 3], graph.op("Gather", count.whole(), [1, 0])))
    places = ((points - low + 0.5) * 2.0 / extent - 1.0).shaped(1, 1, -1, 2)
    colours = graph.op("GridSample", planes, places, mode="bilinear", padding_mode="border", align_corners=0)
    return colours.shaped(3, -1) / 255.0


def cut_square(image: Value, place: Value, size: int, margin: float) -> Value:
    """The square of a picture round a face, upright, as a network takes it.

    It shows what :func:`~torchface.landmarks.images.face_crop.cut_crop` does.

    Args:
        image: uint8 (H,W,C), red first.
        place: of the face (5,), see ``face_place``.
        size: pixels a side of the copy, S.
        margin: side of the square, of the place's.

    Returns:
        (1,3,S,S) in [0,1].
    """
    grid = image.graph.as_value(crop_grid(size, size))
    spacing = side(place) * (margin / size)
    points = turned(grid * spacing, place) + middle(place)
    turn = image.graph.op("Abs", place.rows(3, 5)).reduced("ReduceSum", 0, keep=True)
    return sampled(image, points, spacing, spacing * turn * 0.5 + AROUND).shaped(1, 3, size, size)


def crop_grid(width: int, height: int) -> Tensor:
    """Pixels of a crop beside its middle, (height * width,2)."""
    across, down = (torch.arange(count).float() - (count - 1) / 2 for count in (width, height))
    return torch.stack(torch.meshgrid(across, down, indexing="xy"), -1).reshape(-1, 2)


def from_square(points: Value, place: Value, size: int, margin: float) -> Value:
    """Points (P,2) of the copy that :func:`cut_square` makes, in the picture."""
    scale = side(place) * (margin / size)
    return turned((points - (size - 1) / 2) * scale, place) + middle(place)


def whole_picture(image: Value, longest: int) -> tuple[Value, Value]:
    """A picture made smaller until its longer side has so many pixels, its sides multiples of 32.

    Halved before by interpolation where it is more than twice as large, so that few pixels are skipped.

    Args:
        image: uint8 (H,W,C), red first.
        longest: pixels of the longer side.

    Returns:
        (1,3,h,w) in [0,1], the last rows and columns repeated; and what to multiply its pixels by, (2,), x and y.
    """
    graph: ValueGraph = image.graph
    size = picture_size(image)
    scale = (longest / size.reduced("ReduceMax", 0, keep=True)).least(1.0)
    target = graph.op("Round", size * scale).most(1.0)
    # ONNX Runtime's antialiasing takes three times as long as the network that the picture is for.
    picture = graph.op("Unsqueeze", image, [0])
    for wanted in (size.least(target * 2.0), target):
        sizes = graph.cat([1], graph.op("Gather", wanted.whole(), [1, 0]), graph.op("Shape", image, start=2, end=3))
        picture = graph.op("Resize", picture, graph.none, graph.none, sizes, mode="linear")
    planes = graph.op("Transpose", picture.rows(0, 3, axis=3), perm=[0, 3, 1, 2])
    padded = graph.op("Ceil", target / float(_MULTIPLE)).most(2.0) * float(_MULTIPLE)
    more = graph.op("Gather", (padded - target).whole(), [1, 0])
    planes = graph.op("Pad", planes, graph.cat([0, 0, 0, 0, 0, 0], more), mode="edge")
    return graph.op("Cast", planes, to=TensorProto.FLOAT) / 255.0, size / target
