"""Eyeballs that look somewhere, and where their irises are."""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torchface.shape_names import ARKIT
from torchface.synthetic.head.signed_distance import EYE_CENTRE

from .head_kind import EYEBALL, HeadKind

FULL_GAZE = (30.0, 25.0)
"""Degrees aside and up or down that a weight of 1 of the shapes of glances stands for."""
_RING = (0.28, 0.49)  # radians from the optical axis: the outer part of the iris
_BALL = 0.6  # radians from it where the cornea has ended
_CORNEA = 0.3  # millimetres that it may stand out
_LID = (0.45, 0.9)  # millimetres that the lids' skin lies over the eyeball, at their rims and elsewhere
_REACH = 21.0  # millimetres from an eyeball's middle within which skin is its lids'
_MIRROR = torch.tensor([-1.0, 1.0, 1.0])


def gaze_weights(gaze: Tensor) -> Tensor:
    """ARKit's weights (52,) of lids that follow the gaze of the right and the left eye, (2,2), to the person's left
    and up."""
    weights = torch.zeros(len(ARKIT))
    for row, (side, aside) in enumerate((("Right", "In"), ("Left", "Out"))):
        across, up = (float(angle) / math.radians(full) for angle, full in zip(gaze[row], FULL_GAZE, strict=True))
        away = {"In": "Out", "Out": "In"}[aside]
        weights[ARKIT.index(f"eyeLook{aside if across > 0 else away}{side}")] = min(1.0, abs(across))
        weights[ARKIT.index(f"eyeLook{'Up' if up > 0 else 'Down'}{side}")] = min(1.0, abs(up))
    return weights


def with_turned_eyes(kind: HeadKind, rest: Tensor, posed: Tensor, gaze: Tensor) -> Tensor:
    """A posed head whose eyeballs are those at rest, turned about their middles, with lids that lie on them.

    Weights move lids along straight lines, which half-way cut through the eyeballs: they are put back on them.
    """
    turned = posed.clone()
    for row, eye in enumerate(_eyes(id(kind), kind)):
        points = rest[eye.ball].double()
        middle = _sphere_middle(rest[eye.white].double())
        radius = (rest[eye.white].double() - middle).norm(dim=1).mean()
        ball = _at_most(points - middle, radius + _CORNEA)
        turned[eye.ball] = (ball @ _rotation(gaze[row]).T + middle).to(posed)
        offset, before = turned[eye.lids].double() - middle, (rest[eye.lids].double() - middle).norm(dim=1)
        least = (before + 0.1).clamp(radius + _LID[0], radius + _LID[1])
        length = offset.norm(dim=1)
        turned[eye.lids] = (offset * (length.maximum(least) / length)[:, None] + middle).to(posed)
    return turned


def _at_most(offsets: Tensor, length: Tensor) -> Tensor:
    """Offsets (N,3), none longer than a length."""
    return offsets * (length / offsets.norm(dim=1, keepdim=True)).clamp(max=1)


def iris_centres(kind: HeadKind, posed: Tensor) -> Tensor:
    """The middles (2,3) of the irises' outer rings on a posed head (V,3), the right eye first."""
    return torch.stack([posed[eye.ring].mean(0) for eye in _eyes(id(kind), kind)])


def gaze_toward(kind: HeadKind, rest: Tensor, place: Tensor) -> Tensor:
    """The gaze (2,2) of eyes that look at a place (3,), see :func:`gaze_weights`."""
    angles = []
    for eye in _eyes(id(kind), kind):
        middle = _sphere_middle(rest[eye.white].double())
        way, straight = place.double() - middle, rest[eye.ring].double().mean(0) - middle
        angles.append(_angles(way) - _angles(straight))
    return torch.stack(angles).float()


def _angles(way: Tensor) -> Tensor:
    return torch.stack([torch.atan2(way[0], way[2]), torch.atan2(way[1], way[[0, 2]].norm())])


def _rotation(gaze: Tensor) -> Tensor:
    """The rotation (3,3) by an angle about y, after one about x."""
    (cos_a, cos_b), (sin_a, sin_b) = gaze.double().cos().tolist(), gaze.double().sin().tolist()
    about_y = torch.tensor([[cos_a, 0.0, sin_a], [0.0, 1.0, 0.0], [-sin_a, 0.0, cos_a]], dtype=torch.float64)
    about_x = torch.tensor([[1.0, 0.0, 0.0], [0.0, cos_b, sin_b], [0.0, -sin_b, cos_b]], dtype=torch.float64)
    return about_y @ about_x


def _sphere_middle(points: Tensor) -> Tensor:
    """The middle (3,) of the sphere through points (N,3) in least squares."""
    shift = points.mean(0)
    moved = points - shift
    system = torch.cat([2 * moved, torch.ones(len(moved), 1, dtype=moved.dtype)], dim=1)
    return torch.linalg.lstsq(system, moved.square().sum(1, keepdim=True)).solution[:3, 0] + shift


@dataclass(frozen=True, eq=False)
class _Eye:
    """Vertices of an eyeball, of its white, of the iris's outer ring, and of the lids' skin about it."""

    ball: Tensor
    white: Tensor
    ring: Tensor
    lids: Tensor


@lru_cache(maxsize=4)
def _eyes(_: int, kind: HeadKind) -> tuple[_Eye, ...]:
    """The right eye, then the left."""
    of_ball = torch.zeros(len(kind.canonical), dtype=torch.bool)
    of_ball[kind.faces[kind.material == EYEBALL]] = True
    offset = kind.canonical.float() * torch.where(kind.canonical[:, :1] < 0, _MIRROR, 1.0) - torch.tensor(EYE_CENTRE)
    polar = torch.acos(torch.nn.functional.normalize(offset, dim=1)[:, 2].clamp(-1, 1))
    ring = of_ball & (polar > _RING[0]) & (polar < _RING[1])
    lids = kind.outer & ~of_ball & (kind.marks[:, 3] < 0.5) & (offset[:, 2] > 0) & (offset.norm(dim=1) < _REACH)
    sides = (kind.canonical[:, 0] < 0, kind.canonical[:, 0] > 0)
    sets = (of_ball, of_ball & (polar > _BALL), ring, lids)
    return tuple(_Eye(*((side & one).nonzero()[:, 0] for one in sets)) for side in sides)
