"""Spans of a film that show another face than its first frames: by how faces look and by where their landmarks lie."""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from torchface.capture.own_rig.face_points import LANDMARKS

# A cut: the look correlates by less than the first with that of the frame before, and both frames by more than the
# second with their other neighbours.
_CUT, _STEADY = 0.93, 0.95
# The whole picture changes with it, 1 less the correlation, and so many times as much as before and afterwards: a hand
# that comes before a face takes several frames.
_CHANGE, _SUDDEN = 0.02, 4.0
_MOVED, _GROWN = 1.0, 1.6  # by sides of its box, and by what factor of them: further than a face moves in a frame
_LOST = 10  # frames without a face after which a tracker takes any
_LEAST_FRAMES = 8  # of a span that is judged: a hand before the face looks like nobody
_LEAST_TRUST = 0.1
_MOST_FRAMES = 200  # of each side that are compared
# What the distance of two looks, 1 - correlation, and of two faces' landmarks, in eyes' distances, count; above the
# third it is another face. One person's spans reach 0.65 on the films at hand, two people's least was 0.8.
_LOOK, _LANDMARKS, _MOST = 0.25, 0.03, 0.72
_ALIKE = 0.97  # looks of the same frame of a face, whatever hides of it
_EYES_NOSE = slice(27, 48)


@dataclass(frozen=True, eq=False)
class FilmLooks:
    """How a film and a face in it look.

    Args:
        faces: of each frame's face, (T,C) of unit length, see
            :func:`~torchface.landmarks.images.tracking.followed_face.face_look`; NaN where none was found.
        changes: of the pictures from the frame before, (T,), see
            :func:`~torchface.landmarks.images.picture_cut.sudden_change`.
    """

    faces: Tensor
    changes: Tensor


@dataclass(frozen=True)
class AnotherFace:
    """A span of frames that shows another face."""

    first: int
    last: int
    likeness: float  # the largest correlation of looks, of its frames and the actor's
    apart: float  # the mean distance of its landmarks of eyes and nose from the actor's, in distances of the eyes


@dataclass(frozen=True, eq=False)
class _Span:
    first: int
    last: int
    looks: Tensor
    places: Tensor


def other_faces(looks: FilmLooks, relative: Tensor, trust: Tensor, boxes: Tensor) -> list[AnotherFace]:
    """Which spans of a film show another face than its first span does.

    A film is cut where the picture, and a face's look or place in it, change in one frame, or where the face was lost
    for ten. Each span of eight frames or more is compared with all that showed the first face, by the frames that look
    most alike and by the median places of eyes and nose.

    Args:
        relative: landmarks beside a robust fit of the rig's to each frame, (T,68,2) in distances of the eyes, see
            :func:`~torchface.capture.own_rig.outlier_landmarks.landmark_residuals`.
        trust: of the landmarks, (T,68).
        boxes: x, y, width, height of the faces, (T,4) pixels.
    """
    others: list[AnotherFace] = []
    known: list[_Span] = []
    for span in _spans(looks.faces, relative, trust, _cuts(looks, boxes)):
        if not known:
            known.append(span)
            continue
        likeness = max(float((span.looks @ other.looks.T).max()) for other in known)
        apart = min(_apart(span.places, other.places) for other in known)
        if likeness > _ALIKE or (1 - likeness) / _LOOK + apart / _LANDMARKS < _MOST:
            known.append(span)
        else:
            others.append(AnotherFace(span.first, span.last, likeness, apart))
    return others


def _cuts(looks: FilmLooks, boxes: Tensor) -> Tensor:
    """Frames (T,) bool at which a film may go over to another face; the first is one."""
    faces, changes = looks.faces, looks.changes
    alike = torch.ones(len(faces) + 1)
    alike[1:-1] = (faces[1:] * faces[:-1]).sum(1)  # NaN where one of the two was not found
    cuts = (alike[:-1] < _CUT) & (alike[1:] > _STEADY)
    cuts[1:] &= alike[:-2] > _STEADY
    side, middle = boxes[:, 2], boxes[:, :2] + boxes[:, 2:] / 2
    grown = (side[1:] / side[:-1]).log().abs() > math.log(_GROWN)
    moved = (middle[1:] - middle[:-1]).norm(dim=1) > _MOVED * side[:-1]
    cuts[1:] |= (grown | moved) & (alike[1:-1] < _CUT)
    around = torch.nn.functional.pad(changes, (1, 1))
    cuts &= changes > (_SUDDEN * torch.maximum(around[:-2], around[2:])).clamp(min=_CHANGE)
    unseen = 0
    for t, known in enumerate(torch.isfinite(faces).all(1).tolist()):
        cuts[t] |= known and unseen >= _LOST
        unseen = 0 if known else unseen + 1
    cuts[:1] = True
    return cuts


def _spans(looks: Tensor, relative: Tensor, trust: Tensor, cuts: Tensor) -> list[_Span]:
    seen = torch.isfinite(looks).all(1)
    edges = [*cuts.nonzero()[:, 0].tolist(), len(looks)]
    spans = []
    for first, end in pairwise(edges):
        frames = first + seen[first:end].nonzero()[:, 0]
        if len(frames) < _LEAST_FRAMES:
            continue
        chosen = frames[torch.linspace(0, len(frames) - 1, min(len(frames), _MOST_FRAMES)).round().long()]
        places = torch.where((trust[chosen] > _LEAST_TRUST)[..., None], relative[chosen].double(), torch.nan)
        spans.append(_Span(first, end - 1, looks[chosen], places.nanmedian(0).values))
    return spans


def _apart(one: Tensor, other: Tensor) -> float:
    """The mean distance of landmarks (68,2) of eyes and nose; 0 where they were not seen in both."""
    assert one.shape == (LANDMARKS, 2)
    return float((one - other)[_EYES_NOSE].norm(dim=1).nanmean().nan_to_num(0.0))
