"""A colour picture of someone, cut out of its background, with landmarks and which of them can be seen."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.landmarks.images.ibug_68 import box_around

from .backdrops import uniform
from .expressions import draw_expression, people_expression
from .head_kind import HeadKind
from .lashes import with_lashes
from .people import Person, closed_lids, draw_person
from .picture_geometry import annotated, surface
from .rendered_person import render_person, visible_points
from .spectacles import with_glasses

SIZE = 256
"""Pixels a side of a picture."""
_BOX = 139.0  # pixels a side of the face's box in it
# Millimetres that a landmark may lie behind what is seen, on a curved edge or the contour, and still be visible.
_BEHIND = torch.where(torch.arange(68) < 17, 45.0, 7.0)
_POINT_BEHIND = 6.0
_PEOPLES = 0.6  # of the expressions are those of people who talk and feel; the others reach what people seldom do


@dataclass(frozen=True, eq=False)
class FacePicture:
    """One picture."""

    rgba: Tensor  # uint8 (4,S,S); the fourth channel is 255 on the person, 0 on what is behind
    landmarks: Tensor  # iBUG's 68 as an annotator sees them, (68,2) pixels
    visible: Tensor  # which of them nothing hides, (68,) bool
    points: Tensor  # of the face's surface, (P,2) pixels; see dense_points
    point_visible: Tensor  # which of them nothing hides, (P,) bool
    weights: Tensor  # the expression, (52,) by ARKit's names; a blink of 1 closes this person's lids
    person: int


def draw_pictures(
    kinds: Sequence[HeadKind], shares: Sequence[float], first: int, count: int, seed: int, each: int = 4
) -> list[FacePicture]:
    """Pictures by number, each of a person, an expression, a pose and lights drawn for it, as
    :func:`draw_eye_pictures`."""
    pictures: list[FacePicture] = []
    someone: Person | None = None
    for number in range(first, first + count):  # each has a surface of its own
        person = number // each
        if someone is None or number % each == 0:
            someone = draw_person(kinds, shares, torch.Generator().manual_seed(7_000_003 * seed + 2 * person))
        generator = torch.Generator().manual_seed(7_000_003 * seed + 900_000_000_000 + number)
        pictures.append(replace(_photograph(someone, generator), person=person))
    return pictures


def drawn_weights(generator: torch.Generator) -> Tensor:
    """An expression, (52,) by ARKit's names."""
    return (people_expression if uniform(0, 1, generator) < _PEOPLES else draw_expression)(generator)


def _photograph(person: Person, generator: torch.Generator) -> FacePicture:
    kind, looks = person.kind, person.looks
    weights = drawn_weights(generator)
    posed = closed_lids(kind, person.head, weights)
    scene = surface(kind, person.head, posed, looks, generator)
    camera = drawn_camera(kind, posed, generator)
    pixels = camera.project(posed.double())
    landmarks = annotated(kind, pixels, looks).float()
    shown = render_person(person, scene, camera, generator)
    marks, points = posed[kind.landmarks].double(), pixels[kind.dense].float()
    dark = looks.lashes or looks.liner > 0.3
    image = with_lashes(shown.image, shown.distance, camera, marks, (0.3 * looks.hair).clamp(max=0.14), dark, generator)
    visible = visible_points(shown.distance, camera, marks, landmarks, _BEHIND)
    behind = torch.full((len(points),), _POINT_BEHIND)
    point_visible = visible_points(shown.distance, camera, posed[kind.dense].double(), points, behind)
    if looks.glasses is not None:
        image, hidden = with_glasses(image, camera, marks, looks.glasses, generator)
        visible &= ~hidden
    stored = (255 * image.clamp(0, 1)).round().to(torch.uint8).permute(2, 0, 1).contiguous()
    return FacePicture(stored, landmarks, visible, points, point_visible, weights, 0)


def drawn_camera(
    kind: HeadKind, posed: Tensor, generator: torch.Generator, size: int = SIZE, side: float = _BOX
) -> Camera:
    """A camera for pictures of ``size`` pixels in which the box of a posed head's (V,3) face has ``side``."""
    yaw = (
        float(torch.randn((), generator=generator)) * 20
        if uniform(0, 1, generator) < 0.7
        else uniform(-60, 60, generator)
    )
    # People hold their heads a little lower than heads of databases stand.
    pitch = 5 + 11 * float(torch.randn((), generator=generator).clamp(-2.6, 2.6))
    yaw = max(-65.0, min(65.0, yaw))
    view = 2 * math.degrees(math.atan(0.5 * 220 / math.exp(uniform(math.log(300), math.log(2500), generator))))
    marks = posed[kind.landmarks].double()
    target, span = marks[27:].mean(0), 260.0
    for _ in range(2):  # once for the size, once for the perspective that changes with it
        camera = look_at(target, yaw, pitch, span, size, size, view)
        box = box_around(camera.project(marks).float())
        middle = box[:2] + box[2:] / 2 - (size - 1) / 2
        aside = (middle * span / size).double()
        span = span * float(box[2]) / side
        target = target + aside[0] * camera.rotation[0].double() + aside[1] * camera.rotation[1].double()
    return look_at(target, yaw, pitch, span, size, size, view)
