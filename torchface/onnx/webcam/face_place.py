"""Place of a face in a picture, as values of a graph: middle, side and roll angle of the square round it.

A place is (5,): x and y of the middle, side, cosine and sine of the roll angle, clockwise as the picture is seen.
"""

from __future__ import annotations

import torch

from torchface.landmarks.images.ibug_68 import INNER, MIDDLE_ABOVE, SIDE_OF_EXTENT
from torchface.onnx.graph_values import Value

SIZE = 5


def middle(place: Value) -> Value:
    """(2,)."""
    return place.rows(0, 2)


def side(place: Value) -> Value:
    """(1,)."""
    return place.rows(2, 3)


def turned(points: Value, place: Value) -> Value:
    """Points (P,2) of the upright face's axes in the picture's."""
    graph = points.graph
    cos, sin = place.rows(3, 4), place.rows(4, 5)
    return graph.op("MatMul", points, graph.cat(cos, sin, -sin, cos).shaped(2, 2))


def upright(points: Value, cos: Value, sin: Value) -> Value:
    """Points (P,2) of the picture in the upright face's axes."""
    graph = points.graph
    return graph.op("MatMul", points, graph.cat(cos, -sin, sin, cos).shaped(2, 2))


def place_around(landmarks: Value) -> Value:
    """The place of a face with landmarks (68,2): :func:`~torchface.landmarks.images.ibug_68.turned_box`."""
    graph = landmarks.graph
    right, left, mouth = (
        landmarks.rows(first, end).reduced("ReduceMean", 0) for first, end in ((36, 42), (42, 48), (48, 68))
    )
    across, down = left - right, mouth - (left + right) * 0.5
    cos = across.rows(0, 1) + down.rows(1, 2)
    sin = across.rows(1, 2) - down.rows(0, 1)
    length = graph.op("Sqrt", (cos * cos + sin * sin).most(1e-12))
    cos, sin = cos / length, sin / length
    inner = upright(landmarks.rows(INNER.start, INNER.stop), cos, sin)
    extent = inner.reduced("ReduceMax", 0) - inner.reduced("ReduceMin", 0)
    size = graph.op("Sqrt", (extent * extent).reduced("ReduceMean", 0, keep=True)) * SIDE_OF_EXTENT
    below = graph.as_value(torch.tensor([0.0, -MIDDLE_ABOVE])) * size
    centre = inner.reduced("ReduceMean", 0) + below
    return graph.cat(turned(centre.shaped(1, 2), graph.cat(0.0, 0.0, size, cos, sin)).shaped(2), size, cos, sin)


def sought(place: Value, anchor: Value) -> Value:
    """Where a face is looked for whose place and whose relation (3,) to where it was found are known."""
    offset = turned(anchor.rows(0, 2).shaped(1, 2), place).shaped(2)
    graph = place.graph
    return graph.cat(middle(place) + side(place) * offset, side(place) * anchor.rows(2, 3), place.rows(3, 5))


def relation(place: Value, looked: Value) -> Value:
    """Where a face was looked for, as its own place sees it: the middle in sides of that, and the size; (3,)."""
    graph = place.graph
    offset = (middle(looked) - middle(place)) / side(place)
    own = upright(offset.shaped(1, 2), place.rows(3, 4), place.rows(4, 5)).shaped(2)
    return graph.cat(own.least(0.3).most(-0.3), (side(looked) / side(place)).least(1.4).most(0.7))


def overlap(middles: Value, sides: Value, place: Value) -> Value:
    """The shared share of squares with middles (K,2) and sides (K,1) and that of a place, not turned; (K,1)."""
    own, half, theirs = middle(place), side(place) * 0.5, sides * 0.5
    extent = (middles + theirs).least(own + half) - (middles - theirs).most(own - half)
    extent = extent.most(0.0)
    shared = extent.rows(0, 1, axis=1) * extent.rows(1, 2, axis=1)
    return shared / (sides * sides + side(place) * side(place) - shared).most(1e-6)


def overlap_of(place: Value, other: Value) -> Value:
    """The same of two places, (1,)."""
    return overlap(middle(place).shaped(1, 2), side(place).shaped(1, 1), other).shaped(1)


def plausible(place: Value, size: Value, smallest: float) -> Value:
    """Whether a face can have this place in a picture of a size (2,), width and height; (1,) bool."""
    inside = (middle(place) >= 0.0) & (middle(place) < size)
    both = inside.number().reduced("ReduceMin", 0, keep=True) > 0.5
    return both & (side(place) >= smallest) & (side(place) <= size.reduced("ReduceMax", 0, keep=True) * 1.5)
