"""How a head's own eyes move: balls turn, plates on which eyes are drawn slide."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.geometry.similarity import similarity_transform
from torchface.geometry.spheres import nearest_sphere
from torchface.landmarks.surfaces.eye_openings import Opening
from torchface.modeling.rigging.joined_vertices import JoinedHead
from torchface.rig import BlendshapeRig

_ROUND, _LEAST_BALL, _SMALLEST_BALL, _LARGEST_BALL = 0.12, 12, 0.4, 2.4
"""How far from a sphere an eyeball may be, in radii, its fewest vertices, and its size in the template's."""
_EYEBALL_REACH, _CORNEA = 1.35, 0.8  # radii; the cosine of how far it reaches from its middle
_BEHIND_LIDS, _OFF_THE_EYE, _PLATE = 1.5, 0.25, 1.8  # millimetres; widths of the opening: off its middle, a plate's
_EYE_WIDTH, _IRIS, _ROUND_MIDDLE = 30.0, 0.35, 0.5  # millimetres of a person's opening; its share that an iris takes


def eyeballs(template: BlendshapeRig) -> list[Tensor]:
    """The vertices (V,) bool of the template's left and right eyeball, where it names them."""
    notes = template.neutral.annotations
    regions = {} if notes is None else notes.regions
    return [regions[name].cpu() for name in ("eyeball_left", "eyeball_right") if name in regions]


def turned(head: JoinedHead, template: BlendshapeRig, eyeball: Tensor, left: Tensor) -> Tensor:
    """Turns what lies within an eyeball of the template; which vertices that is, (J,)."""
    rest = template.vertices.double().cpu()[eyeball]
    centre = (rest.amax(0) + rest.amin(0)) / 2
    radius = float((rest - centre).norm(dim=-1).median())
    middle, size = _own_ball(head, left, centre, radius)
    inside = (head.vertices - middle).norm(dim=-1) < _EYEBALL_REACH * size
    own = torch.zeros_like(left)
    for one in head.part[inside & left].unique().tolist():  # a head has a handful of such parts
        rows = head.part == one
        if bool(inside[rows].all()) and _is_of_the_eye(head.vertices[rows] - middle, size):
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


def slid(head: JoinedHead, template: BlendshapeRig, eyeball: Tensor, opening: Opening | None, left: Tensor) -> Tensor:
    """Slides plates on which an eye is drawn as far as an eyeball's pole goes; which vertices those are, (J,).

    Of several the hindmost stays, as the white, and those before it go; where these are highlights alone, its middle
    goes too, and its rim stays so that no gap opens beside it.
    """
    own = torch.zeros_like(left)
    if opening is None:
        return own
    edge = torch.cat([opening.upper, opening.lower])
    middle, width = edge.mean(0), float(edge[:, 0].amax() - edge[:, 0].amin())
    plates = []
    for one in head.part[left & ((head.vertices - middle).norm(dim=-1) < width)].unique().tolist():
        points = head.vertices[head.part == one]
        away, extent = points.mean(0) - middle, points.amax(0) - points.amin(0)
        beside = torch.cdist(points[:, :2], edge[:, :2]).argmin(1)
        behind = float((points - edge[beside])[:, 2].mean()) < -_BEHIND_LIDS
        if behind and float(away[:2].norm()) < _OFF_THE_EYE * width and float(extent[:2].amax()) < _PLATE * width:
            plates.append(head.part == one)
            own |= plates[-1]
    if not plates:
        return own
    back, *before = sorted(plates, key=lambda rows: float(head.vertices[rows, 2].mean()))
    irises = any(
        float(head.vertices[rows, 0].amax() - head.vertices[rows, 0].amin()) > _IRIS * width for rows in before
    )
    rest = template.vertices.double().cpu()[eyeball]
    pole = eyeball.nonzero()[:, 0][rest[:, 2].argmax()]
    way = template.deltas.double().cpu()[:, pole] * max(1.0, width / _EYE_WIDTH)
    head.deltas[:, own] = 0.0
    for rows in before if irises else plates:
        points = head.vertices[rows]
        normal = torch.linalg.svd(points - points.mean(0))[2][2]
        along = way - (way @ normal)[:, None] * normal
        share = torch.ones(len(points), dtype=torch.float64)
        if rows is back:
            out = (points - points.mean(0))[:, :2] / ((points.amax(0) - points.amin(0))[:2] / 2).clamp(min=1e-6)
            held = (1 - out.square().sum(-1)).clamp(min=0)
            share = held / held.max() if float(held.max()) > _ROUND_MIDDLE else share
        head.deltas[:, rows] = along[:, None] * share[:, None]
    return own


def _own_ball(head: JoinedHead, left: Tensor, centre: Tensor, radius: float) -> tuple[Tensor, float]:
    """Middle and radius of the head's own eyeball, which may be larger or smaller than the template's; else its."""
    near = (head.vertices - centre).norm(dim=-1) < _LARGEST_BALL * radius
    best, found = _ROUND, (centre, radius)
    for one in head.part[near & left].unique().tolist():
        rows = head.part == one
        if not bool(near[rows].all()) or int(rows.sum()) < _LEAST_BALL:
            continue
        points = head.vertices[rows]
        middle, size = nearest_sphere(points)
        off = float(((points - middle).norm(dim=-1) - size).abs().mean()) / size
        around = float((points.mean(0) - middle).norm()) < 0.5 * size  # a shell before the eye lies on one side
        if around and off < best and float((middle - centre).norm()) < radius and size > _SMALLEST_BALL * radius:
            best, found = off, (middle, size)
    return found


def _is_of_the_eye(points: Tensor, radius: float) -> bool:
    """Whether a part is a ball, or lies on it as a cornea or an iris does; lashes and shells under lids do not."""
    middle = points.mean(0)
    if float(middle.norm()) < 0.5 * radius:
        return float((points.amax(0) - points.amin(0)).max()) > radius
    away = torch.nn.functional.normalize(points, dim=-1) @ torch.nn.functional.normalize(middle, dim=0)
    return float(away.min()) > _CORNEA
