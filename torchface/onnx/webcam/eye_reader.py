"""Reading of a face's two eyes in a picture, as values of a graph."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchface.landmarks.images.networks.eye_crop import DOWN, EYE_LANDMARKS, NOSE_BASE, SHARE
from torchface.landmarks.images.networks.eye_finder import HIDDEN, LEAST, PLACES, SEEN
from torchface.landmarks.images.networks.eye_network import EyeFindings, EyeNetwork
from torchface.onnx.eye_network_graph import eye_nodes
from torchface.onnx.graph_values import Value
from torchface.onnx.webcam.face_place import turned
from torchface.onnx.webcam.picture_pieces import AROUND, crop_grid, sampled

_LIDS = 6


@dataclass(frozen=True)
class ReadEyes:
    """A face's landmarks with its lids where both networks together put them, and its eyes.

    Args:
        landmarks, deviation: (68,2) and (68,) pixels of the picture.
        iris: (2,2) pixels of the picture.
        openness, closed, visibility: (2,), the person's right eye first; NaN, NaN and 0 of eyes that are too small.
    """

    landmarks: Value
    deviation: Value
    iris: Value
    openness: Value
    closed: Value
    visibility: Value


def read_eyes(image: Value, landmarks: Value, deviation: Value, network: EyeNetwork) -> ReadEyes:
    """The eyes of a face: ``EyeFinder`` in a graph.

    Args:
        image: uint8 (H,W,C), red first.
        landmarks, deviation: (68,2) and (68,) pixels of the picture, finite.
        network: is shown both eyes, the left in a mirror.
    """
    graph = image.graph
    rows = graph.op("Gather", landmarks, [36, 39, 42, 45])
    corners = rows.shaped(2, 2, 2).reduced("ReduceMean", 1)
    middle = corners.reduced("ReduceMean", 0)
    across = (corners.rows(1, 2) - corners.rows(0, 1)).shaped(2)
    down = landmarks.rows(48, 68).reduced("ReduceMean", 0) - middle
    nose = landmarks.rows(NOSE_BASE, NOSE_BASE + 1).shaped(2) - middle
    upright = graph.cat(across.rows(0, 1) + down.rows(1, 2), across.rows(1, 2) - down.rows(0, 1))
    upright = upright / graph.op("Sqrt", _squared(upright).most(1e-12))
    squares = _squared(across) + _squared(nose) * DOWN**2
    spacing = graph.op("Sqrt", (squares * 0.5).most(1.0)) * (SHARE / network.width)
    frame = graph.cat(middle, spacing, upright)
    mirror = torch.tensor([[[1.0, 1.0]], [[-1.0, 1.0]]])
    grid = graph.as_value(crop_grid(network.width, network.height)[None] * mirror)  # (2,P,2)
    centres = corners.shaped(2, 1, 2)
    points = turned((grid * spacing).shaped(-1, 2), frame).shaped(2, -1, 2) + centres
    colours = sampled(image, points.shaped(-1, 2), spacing, graph.as_value(AROUND))
    colours = colours.shaped(3, 2, network.height, network.width)
    eyes = graph.op("Transpose", colours, perm=[1, 0, 2, 3])
    names = {name: f"eyes {name}" for name in EyeFindings._fields}
    eye_nodes(graph.build, network, eyes.name, names)
    found = {name: graph.value(value) for name, value in names.items()}
    own = graph.cat(found["landmarks"].shaped(2, _LIDS, 2), found["iris"].shaped(2, 1, 2), axis=1)
    offsets = (own - torch.tensor([(network.width - 1) / 2, (network.height - 1) / 2])) * mirror * spacing
    placed = turned(offsets.shaped(-1, 2), frame).shaped(2, _LIDS + 1, 2) + centres
    # Smaller eyes nobody can see.
    fine = spacing * float(network.width) >= LEAST
    visibility = found["visibility"].shaped(2) * fine.number()
    share = ((visibility - HIDDEN) / (SEEN - HIDDEN)).least(1.0).most(0.0)
    spread = found["deviation"].rows(0, _LIDS, axis=1) * spacing
    theirs = graph.op("Gather", (share.shaped(2, 1) / (spread * spread)).shaped(-1), PLACES)
    lids = graph.op("Gather", placed.rows(0, _LIDS, axis=1).shaped(-1, 2), PLACES)
    first, end = min(map(min, EYE_LANDMARKS)), max(map(max, EYE_LANDMARKS)) + 1
    before, nan = deviation.rows(first, end), float("nan")
    mine = 1.0 / (before * before)
    both = mine + theirs
    merged = (landmarks.rows(first, end) * mine.shaped(-1, 1) + lids * theirs.shaped(-1, 1)) / both.shaped(-1, 1)
    return ReadEyes(
        graph.cat(landmarks.rows(0, first), merged, landmarks.rows(end, 68)),
        graph.cat(deviation.rows(0, first), 1.0 / graph.op("Sqrt", both), deviation.rows(end, 68)),
        graph.where(fine, placed.rows(_LIDS, _LIDS + 1, axis=1).shaped(2, 2), nan),
        graph.where(fine, found["openness"].shaped(2), nan),
        graph.where(fine, found["closed"].shaped(2), nan),
        visibility,
    )


def _squared(vector: Value) -> Value:
    """The squared length (1,)."""
    return (vector * vector).reduced("ReduceSum", 0, keep=True)
