"""The motion of a head's loose parts (eyeballs, teeth, gums, tongue, lashes) in shapes that its skin has."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.rig import BlendshapeRig

_EYEBALL_REACH = 1.35
_IN_THE_MOUTH = 45.0  # millimetres
_MOUTH_HEIGHT = 25.0
_JAW = "jaw"
_TONGUE_WIDTH, _TONGUE_DEPTH = 15.0, 15.0  # millimetres at least: teeth are smaller


@dataclass(frozen=True, eq=False)
class _Head:
    """A head's joined mesh in the template's place, and its skin's deltas."""

    vertices: Tensor
    part: Tensor
    loose: Tensor
    deltas: Tensor


def moved_parts(
    template: BlendshapeRig, vertices: Tensor, faces: Tensor, part: Tensor, loose: Tensor, deltas: Tensor
) -> tuple[Tensor, Tensor]:
    """Deltas of a head's loose parts beside those of its skin.

    What lies within a template's eyeball turns as it does, about its own middle. What lies in the mouth is bone: above
    the line of the lips it stays, below it goes with the jaw. The rest goes with the nearest skin.

    Args:
        template: the template's rig on this head's face, with iBUG's 68 landmarks; without landmarks or eyeballs all
            parts go with the skin.
        vertices: of the head, (J,3) float64, in the template's place.
        faces: (F,3).
        part: connected part of each vertex, (J,).
        loose: vertices of parts that are no skin, (J,) bool.
        deltas: of the skin, (N,J,3).

    Returns:
        Deltas (N,J,3), and the vertices of the head's tongue (J,).
    """
    deltas, tongue = deltas.clone(), torch.zeros(len(vertices), dtype=torch.bool)
    if not loose.any():
        return deltas, tongue
    head = _Head(vertices, part, loose, deltas)
    left = loose.clone()
    for eyeball in _eyeballs(template):
        left &= ~_turned(head, template, eyeball, left)
    notes = template.neutral.annotations
    if notes is not None and notes.landmarks is not None and len(notes.landmarks) == 68:
        mouth = template.vertices.double().cpu()[notes.landmarks.cpu()[48:68]]
        lower, upper, tongue = _in_the_mouth(head, left, mouth)
        jaw = _jaw_motions(template)
        ids = lower.nonzero()[:, 0]
        if len(ids):
            deltas[:, ids] = jaw.apply(vertices[ids]) - vertices[ids]
        left &= ~(lower | upper)
    ids, skin = left.nonzero()[:, 0], (~loose).nonzero()[:, 0]
    if len(ids):
        beside = skin[torch.from_numpy(cKDTree(vertices[skin].numpy()).query(vertices[ids].numpy())[1])]
        deltas[:, ids] = deltas[:, beside]
    return deltas, tongue


def _eyeballs(template: BlendshapeRig) -> list[Tensor]:
    notes = template.neutral.annotations
    regions = {} if notes is None else notes.regions
    return [regions[name].cpu() for name in ("eyeball_left", "eyeball_right") if name in regions]


def _turned(head: _Head, template: BlendshapeRig, eyeball: Tensor, left: Tensor) -> Tensor:
    """Turns what lies within an eyeball of the template; which vertices that is, (J,)."""
    rest = template.vertices.double().cpu()[eyeball]
    centre = (rest.amax(0) + rest.amin(0)) / 2
    radius = float((rest - centre).norm(dim=-1).median())
    inside = (head.vertices - centre).norm(dim=-1) < _EYEBALL_REACH * radius
    own = torch.zeros_like(left)
    for one in head.part[inside & left].unique().tolist():  # a head has a handful of such parts
        rows = head.part == one
        span = head.vertices[rows].amax(0) - head.vertices[rows].amin(0)
        if bool(inside[rows].double().mean() > 0.9) and float(span.max()) > 0.4 * radius:
            own |= rows
    ids = own.nonzero()[:, 0]
    if not len(ids):
        return own
    points = head.vertices[ids]
    sizes = head.part[ids].unique(return_counts=True)
    ball = points[head.part[ids] == sizes[0][sizes[1].argmax()]]
    middle = (ball.amax(0) + ball.amin(0)) / 2
    posed = rest + template.deltas.double().cpu()[:, eyeball]
    motion = similarity_transform(rest.expand_as(posed), posed, scale=False)
    shift = motion.apply(centre[None])[:, 0] - centre
    head.deltas[:, ids] = (points - middle) @ motion.rotation.transpose(1, 2) + middle + shift[:, None] - points
    return own


def _in_the_mouth(head: _Head, left: Tensor, lips: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices (J,) of parts behind the lips, below and above their line, and of the tongue."""
    middle = lips.mean(0)
    lower, upper, tongue = (torch.zeros_like(left) for _ in range(3))
    widest = 0.0
    for one in head.part[left].unique().tolist():  # every tooth is a part
        rows = (head.part == one) & left
        points = head.vertices[rows]
        away = points.mean(0) - middle
        behind = float(away[2]) < 2.0 and float(away.norm()) < _IN_THE_MOUTH and abs(float(away[1])) < _MOUTH_HEIGHT
        if not behind or float((points - middle).norm(dim=-1).max()) > 2 * _IN_THE_MOUTH:
            continue
        if float(away[1]) > 0:
            upper |= rows
            continue
        lower |= rows
        width, _, depth = (points.amax(0) - points.amin(0)).tolist()
        filled = float((points[:, 0].abs() < 5.0).double().mean())  # gums are an arch, hollow in the middle
        if width > _TONGUE_WIDTH and depth > _TONGUE_DEPTH and filled > max(widest, 0.2):
            widest, tongue = filled, rows
    return lower, upper, tongue


def _jaw_motions(template: BlendshapeRig) -> Similarity:
    """How the jaw's bone moves in each shape, a batch of N: as the chin's skin in shapes of the jaw, else not."""
    notes = template.neutral.annotations
    regions = {} if notes is None else notes.regions
    chin = regions.get("chin", regions.get("jaw"))
    rest = template.vertices.double().cpu()
    if chin is None:
        assert notes is not None
        assert notes.landmarks is not None
        chin = notes.landmarks.cpu()[[5, 6, 7, 8, 9, 10, 11]]
    posed = rest[chin] + template.deltas.double().cpu()[:, chin]
    motion = similarity_transform(rest[chin].expand_as(posed), posed, scale=False)
    jaw = torch.tensor([name.startswith(_JAW) for name in template.names])
    rotation = torch.where(jaw[:, None, None], motion.rotation, torch.eye(3, dtype=torch.float64))
    translation = torch.where(jaw[:, None], motion.translation, 0.0)
    return Similarity(torch.ones_like(motion.scale), rotation, translation)
