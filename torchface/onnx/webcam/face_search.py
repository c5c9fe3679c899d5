"""Choice among the faces that the box network finds in a picture, as values of a graph."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchface.landmarks.images.boxes.box_network import BoxNetwork
from torchface.onnx.face_box_graph import box_network_nodes
from torchface.onnx.graph_values import Value
from torchface.onnx.webcam.face_place import middle, overlap, side
from torchface.onnx.webcam.picture_pieces import whole_picture

_NEAR, _SMALLER, _LARGER = 0.75, 0.6, 1.6
_FIRST = 1e6  # more than any side: a face that is near goes before all others
# Cosine and sine of the roll angles, 50 degrees either way, that faces are looked for at where what the network says
# (the first) shows none.
_LEANING = ((1.0, 0.0), (1.0, 0.0), (0.643, 0.766), (0.643, -0.766))
FOUND = 7
"""Numbers that a search gives."""


@dataclass(frozen=True)
class SearchSettings:
    """Where faces are looked for.

    Args:
        longest: pixels of the longer side of the picture that the box network is shown.
        score: that a face has at least.
        again: score that confirms a face which is followed.
        overlap: of the two, at least.
        candidates: faces that are tried in turn, a frame each, where the landmark network refuses one.
    """

    longest: int = 640
    score: float = 0.4
    again: float = 0.3
    overlap: float = 0.25
    candidates: int = 4


def search(
    image: Value, network: BoxNetwork, settings: SearchSettings, place: Value, waiting: Value, attempt: Value
) -> Value:
    """The face that is meant, as nodes at the present place of the graph.

    Args:
        image: uint8 (H,W,C).
        network: finds boxes.
        settings: where faces are looked for.
        place: where the face was last (5,); side 0 where there was none.
        waiting: whether another face than one near there is refused where several are about, (1,) bool.
        attempt: how many were refused since the last was lost, (1,).

    Returns:
        Its place (5,); whether there is one (1,); whether a face is seen at the last place (1,).
    """
    graph = image.graph
    picture, ratio = whole_picture(image, settings.longest)
    faces = graph.value(box_network_nodes(graph.build, network, picture.name)).shaped(network.faces, 6)
    middles = (faces.rows(0, 2, axis=1) + 0.5) * ratio - 0.5
    sides = faces.rows(2, 3, axis=1) * ratio.reduced("ReduceMean", 0, keep=True)
    scores, angles = faces.rows(3, 4, axis=1), faces.rows(4, 6, axis=1)
    known = side(place) > 0.0
    last = side(place).most(1.0)
    away = (middles - middle(place)) / last
    distance = graph.op("Sqrt", (away * away).reduced("ReduceSum", 1, keep=True))
    growth = sides / last
    near = (distance < _NEAR) & (growth > _SMALLER) & (growth < _LARGER) & known
    likely = scores >= settings.score
    alone = likely.number().reduced("ReduceSum", 0, keep=True).shaped(1) <= 1.0
    meant = likely & (near | ~known | ~waiting | alone)
    preference = graph.where(near, (2.0 - distance) * _FIRST, sides * scores)
    preference = graph.where(meant, preference, 0.0).shaped(network.faces)
    order, rows = graph.two_of("TopK", preference, [settings.candidates])
    count = (order > 0.0).number().reduced("ReduceSum", 0, keep=True)
    rounds = graph.op("Floor", attempt / count.most(1.0))
    row = graph.op("Gather", rows, (attempt - rounds * count.most(1.0)).whole())
    chosen = graph.op("Gather", graph.cat(middles, sides, angles, axis=1), row).shaped(5)
    # The network may take a leaning face for one that is upside down: refused ones are looked at in other ways.
    other = rounds - graph.op("Floor", rounds / float(len(_LEANING))) * float(len(_LEANING))
    angle = graph.op("Gather", graph.as_value(torch.tensor(_LEANING)), other.whole()).shaped(2)
    chosen = graph.cat(chosen.rows(0, 3), graph.where(other > 0.0, angle, chosen.rows(3, 5)))
    there = (overlap(middles, sides, place) > settings.overlap) & (scores >= settings.again)
    seen = there.number().reduced("ReduceMax", 0).shaped(1)
    return graph.cat(chosen, (count > 0.0).number(), seen)
