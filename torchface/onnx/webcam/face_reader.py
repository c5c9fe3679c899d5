"""Reading of one face in a webcam's pictures, frame after frame, as values of a graph."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from torchface.landmarks.images.boxes.box_network import BoxNetwork
from torchface.landmarks.images.face_reading import HALF_CONFIDENCE
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.landmarks.images.networks.landmark_network import LandmarkNetwork
from torchface.onnx.graph_values import Value, ValueGraph
from torchface.onnx.landmark_network_graph import landmark_network_nodes
from torchface.onnx.webcam.eye_reader import read_eyes
from torchface.onnx.webcam.face_place import overlap_of, place_around, plausible, relation, side, sought
from torchface.onnx.webcam.face_search import FOUND, SearchSettings, search
from torchface.onnx.webcam.picture_pieces import cut_square, from_square, picture_size

STATE = 15
"""Numbers that a reader hands on."""

_SEEN = 4 * COUNT + 1  # landmarks, deviation, visibility, presence
_FAR, _LOOSE = 0.75, 0.25  # shared share of two places
_LONGEST = 0.5  # seconds: after a longer break the face may be anywhere
_ANYWHERE = torch.tensor([32.0, 32.0, 64.0, 1.0, 0.0])  # a place, where there is none to look at
_SHRUNK, _GROWN = 0.6, 1.6  # of a face from one picture to the next
_LONG = 1e3  # seconds


@dataclass(frozen=True)
class ReaderSettings:
    """When a face counts as found and as lost.

    Args:
        new: presence from which what the box network finds is a face.
        vague: mean confidence of the landmarks under which it is none, and under which one that is followed is doubted.
        sure: presence from which nothing is asked about a face that is followed.
        likely: presence from which it is kept though the box network sees none.
        least: presence under which it is lost at once.
        doubt: seconds of presence below ``sure`` and the like after which the box network is asked, again and again.
        patience: seconds for which a lost face is waited for at its place before another of several is taken.
        eager: seconds after a face was lost in which every frame is searched.
        pause: seconds between searches afterwards.
        smallest: pixels a side of the box round a face, at least.
        search: where faces are looked for.
    """

    new: float = 0.6
    vague: float = 0.5
    sure: float = 0.9
    likely: float = 0.5
    least: float = 0.1
    doubt: float = 0.25
    patience: float = 0.3
    eager: float = 0.5
    pause: float = 0.1
    smallest: float = 12.0
    search: SearchSettings = field(default_factory=SearchSettings)


@dataclass(frozen=True, eq=False)
class WebcamNetworks:
    """What read faces.

    Args:
        boxes: finds faces in pictures.
        landmarks: finds landmarks in a face.
        eyes: finds lids and irises in an eye.
    """

    boxes: BoxNetwork
    landmarks: LandmarkNetwork
    eyes: EyeNetwork


@dataclass(frozen=True)
class ReadFace:
    """A :class:`~torchface.landmarks.images.face_reading.FaceReading` as values of a graph, and what the next takes.

    Args:
        landmarks: (68,2) pixels of the picture; NaN without a face.
        deviation: (68,) pixels.
        visibility: (68,); 0 without a face.
        presence: (1,); 0 without a face.
        iris: (2,2) pixels; NaN without a face.
        openness, closed, eye_visibility: (2,), the person's right eye first.
        state: (STATE,), what the reader of the next picture takes.
    """

    landmarks: Value
    deviation: Value
    visibility: Value
    presence: Value
    iris: Value
    openness: Value
    closed: Value
    eye_visibility: Value
    state: Value


def read_face(
    graph: ValueGraph,
    image: Value,
    interval: Value,
    state: Value,
    networks: WebcamNetworks,
    settings: ReaderSettings,
) -> ReadFace:
    """One face in the next picture.

    A face is looked for in the square round where it was in the picture before, turned as it was and as it lay to the
    landmarks when it was found: one that moved far is looked at once more. Without one the box network looks for it.

    Args:
        graph: that the nodes become part of.
        image: uint8 (H,W,C), 3 channels or 4, red first.
        interval: seconds since the picture before, (1,), finite and positive.
        state: what the reader of the picture before left, (STATE,); zeros before the first.
        networks: what read it.
        settings: when a face counts as found and as lost.
    """
    place, anchor = state.rows(0, 5), state.rows(5, 8)
    following, missing, doubt, since, attempt = (state.rows(at, at + 1) for at in range(8, 13))
    size = picture_size(image)
    same = size.equals(state.rows(13, 15)).number().reduced("ReduceMin", 0, keep=True)
    # Another picture size is another camera: its face may be anywhere.
    place = place * same
    followed = (following > 0.5) & (same > 0.5) & (interval <= _LONGEST)
    asked = followed & (doubt >= settings.doubt) & (since >= settings.doubt)
    lost_now = ~followed & ((missing <= settings.eager) | (since >= settings.pause))
    nothing = graph.as_value(torch.zeros(FOUND))
    searched = asked | lost_now
    found = graph.either(
        searched,
        lambda: search(image, networks.boxes, settings.search, place, missing < settings.patience, attempt),
        lambda: nothing,
    )
    there = found.rows(5, 6) > 0.5
    begin = graph.where(followed, sought(place, anchor), found.rows(0, 5))
    ready = plausible(begin, size, settings.smallest) & (followed | there)
    first = graph.where(ready, begin, _ANYWHERE)
    # The network runs on every picture, as ONNX Runtime makes it half as fast inside of a branch.
    seen = _look(graph, image, first, networks.landmarks)
    moved = place_around(seen.rows(0, 2 * COUNT).shaped(COUNT, 2))
    shared = overlap_of(graph.where(followed, place, first), moved)
    # Boxes of the box network fit loosely, but what lies beside them is not their face.
    again = graph.where(followed, (shared < _FAR).number(), (shared >= _LOOSE).number()) > 0.5
    again = again & ready & plausible(moved, size, settings.smallest)
    looked = graph.where(again, graph.where(followed, sought(moved, anchor), moved), first)
    seen = graph.either(again, lambda: _look(graph, image, looked, networks.landmarks), lambda: seen)
    marks, presence = seen.rows(0, 2 * COUNT).shaped(COUNT, 2), seen.rows(4 * COUNT, _SEEN)
    own = place_around(marks)
    growth = side(own) / side(place).most(1.0)
    confident = _confidence(seen.rows(2 * COUNT, 3 * COUNT), own)
    vague = confident < settings.vague
    confirmed = found.rows(6, 7) > 0.5
    kept = ((presence >= settings.likely) & ~vague) | ~asked | confirmed
    kept = kept & (presence >= settings.least) & (growth > _SHRUNK) & (growth < _GROWN)
    good = (followed & kept) | (~followed & ~vague & (presence >= settings.new))
    good = good & ready & plausible(own, size, settings.smallest)
    clear = ((presence >= settings.sure) & ~vague) | confirmed
    refused = lost_now & there & ~good
    after = graph.cat(
        graph.where(good, own, place),
        graph.where(followed, anchor, graph.where(good, relation(own, looked), anchor)),
        good.number(),
        graph.where(good, 0.0, (missing + interval).least(_LONG)),
        graph.where(good & ~clear, doubt + interval, 0.0),
        graph.where(searched, 0.0, (since + interval).least(_LONG)),
        graph.where(refused, attempt + 1.0, 0.0),
        size,
    )
    eyes = read_eyes(image, marks, seen.rows(2 * COUNT, 3 * COUNT), networks.eyes)
    share, nan = good.number(), float("nan")
    return ReadFace(
        graph.where(good, eyes.landmarks, nan),
        eyes.deviation,
        seen.rows(3 * COUNT, 4 * COUNT) * share,
        presence * share,
        graph.where(good, eyes.iris, nan),
        graph.where(good, eyes.openness, nan),
        graph.where(good, eyes.closed, nan),
        eyes.visibility * share,
        after,
    )


def _look(graph: ValueGraph, image: Value, place: Value, network: LandmarkNetwork) -> Value:
    """What the network finds in the square round a place: landmarks, deviation, visibility, presence in one row."""
    square = cut_square(image, place, network.size, network.margin)
    names = landmark_network_nodes(graph.build, network, square.name, f"{square.name}_")
    marks, deviation, visibility, presence = (graph.value(name) for name in names)
    marks = from_square(marks.shaped(COUNT, 2), place, network.size, network.margin)
    deviation = deviation.shaped(COUNT) * side(place) * (network.margin / network.size)
    return graph.cat(marks.shaped(2 * COUNT), deviation, visibility.shaped(COUNT), presence)


def _confidence(deviation: Value, place: Value) -> Value:
    """The mean (1,) of :func:`~torchface.landmarks.images.face_reading.confidence_of` deviations (68,) in pixels."""
    share = deviation / (side(place).most(1.0) * HALF_CONFIDENCE)
    return (1.0 / (share * share + 1.0)).reduced("ReduceMean", 0, keep=True)
