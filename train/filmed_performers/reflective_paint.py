"""A pattern of white reflective strokes, painted by hand between the markers, that moves with the skin."""

import math
from functools import lru_cache

import torch
from torch import Tensor

from torchface.geometry.meshes.rasterization import TexelMap
from torchface.synthetic.head.identity import both_sides, ramp, sculpted_vertices
from torchface.synthetic.head.skin_texture import texel_values
from torchface.synthetic.head.topology import EYE_RIM, MOUTH_BORDER, topology

# Strokes of the left half from (x,y) to (x,y), millimetres on the mean head seen from the front: over the inner brow
# (AU 1), over the outer brow (AU 2), between the brows (AU 4) and beside the nose's root (AU 9).
_STROKES = (
    (7.0, 27.0, 7.0, 38.0), (14.0, 28.5, 14.0, 39.5), (21.0, 30.0, 21.5, 40.0),
    (30.0, 30.5, 31.0, 39.5), (37.5, 29.5, 39.5, 38.0), (44.5, 26.5, 47.5, 34.0),
    (4.0, 11.0, 6.5, 19.5), (-2.5, 23.0, 2.5, 23.0),
    (-3.5, 6.5, 3.5, 6.5), (-3.5, 0.5, 3.5, 0.5), (-3.5, -5.5, 3.5, -5.5),
    (8.5, 6.0, 11.5, 1.0), (8.0, -5.0, 12.0, -10.5), (9.0, -15.5, 13.5, -20.5),
)  # fmt: skip
_STROKE_WIDTH = 0.95
_SOFT = 0.45  # millimetres over which a stroke's edge fades
# Dashes that run along rings of the mesh: from ring, to ring, how many round it, share of a step that is painted.
_UPPER_LID = (4.6, 6.7)
_LOWER_LID = (3.2, 5.2)
_LID_DASHES, _LID_SHARE = 14, 0.55
_LIPS = (1.1, 2.8)
_LIP_DASHES, _LIP_SHARE = 9, 0.44


def reflective_paint(size: int = 1024, generator: torch.Generator | None = None, unsteadiness: float = 0.5) -> Tensor:
    """Where the paint is, as a texture of the performer's skin, (size,size) in [0,1], first row on top.

    Strokes over the inner and the outer brows, between the brows and down the nose's root, dashes on the upper and the
    lower lids and round the lips.
    """
    texels, values = _painted_texels(size)
    points = values[:, :3]
    if generator is not None:
        points = points + unsteadiness * _wander(points, generator)
    paint = torch.zeros(size * size)
    amount = torch.stack([_strokes(points), _lid_dashes(values), _lip_dashes(values)]).amax(0)
    paint[texels.texels] = amount * (points[:, 2] > 40)
    return paint.view(size, size)


@lru_cache(maxsize=2)
def _painted_texels(size: int) -> tuple[TexelMap, Tensor]:
    return texel_values(size, torch.cat([sculpted_vertices().float(), _ring_places()], dim=1))


def _ring_places() -> Tensor:
    """Where on the rings round eye and mouth each vertex is, (V,5): ring and direction at the eye, ring and way at
    the mouth (0 at the upper midline, 1 at the lower)."""
    t = topology()
    places = torch.zeros(t.count, 5)
    turn = 2 * math.pi * torch.arange(32) / 32
    for side in (0, 1):
        eye, mouth = both_sides(t.rings["eye"])[side], both_sides(t.rings["mouth"])[side]
        places[eye, 0] = torch.arange(len(eye)).float()[:, None].expand(-1, 32)
        places[eye, 1], places[eye, 2] = turn.cos().expand(len(eye), -1), turn.sin().expand(len(eye), -1)
        places[mouth, 3] = torch.arange(len(mouth)).float()[:, None].expand(-1, 27)
        places[mouth, 4] = (torch.arange(27) / 26.0).expand(len(mouth), -1)
    return places


def _wander(points: Tensor, generator: torch.Generator) -> Tensor:
    """A smooth random displacement (N,3) of unit deviation that changes over about two centimetres."""
    waves = 12
    heading = torch.nn.functional.normalize(torch.randn(3, waves, 3, generator=generator), dim=-1)
    length = 14.0 + 26.0 * torch.rand(3, waves, 1, generator=generator)
    phase = 2 * math.pi * torch.rand(3, waves, generator=generator)
    angle = torch.einsum("nc,awc->naw", points, heading * (2 * math.pi / length)) + phase
    return angle.sin().sum(-1) * math.sqrt(2 / waves)


def _strokes(points: Tensor) -> Tensor:
    """Share of paint (N,) of the straight strokes, both sides of the face."""
    place = torch.stack([points[:, 0].abs(), points[:, 1]], dim=1)
    lines = torch.tensor(_STROKES)
    start, way = lines[:, :2], lines[:, 2:] - lines[:, :2]
    along = ((place[:, None] - start) * way).sum(-1) / way.square().sum(-1)
    distance = (place[:, None] - start - along.clamp(0, 1)[..., None] * way).norm(dim=-1).amin(1)
    return 1 - ramp(distance, _STROKE_WIDTH - _SOFT, _STROKE_WIDTH + _SOFT)


def _band(ring: Tensor, band: tuple[float, float]) -> Tensor:
    return ramp(ring, band[0] - 0.3, band[0] + 0.3) * (1 - ramp(ring, band[1] - 0.3, band[1] + 0.3))


def _dashed(place: Tensor, count: int, share: float) -> Tensor:
    """1 on ``count`` dashes over places 0 to 1."""
    step = (place * count).frac()
    distance = (step - 0.5).abs()
    return 1 - ramp(distance, share / 2 - 0.1, share / 2 + 0.1)


def _lid_dashes(values: Tensor) -> Tensor:
    # Rings run clockwise from the upper left corner of the block: the first half is the upper side.
    turn = torch.atan2(values[:, 5], values[:, 4]).remainder(2 * math.pi) / (2 * math.pi)
    ring = values[:, 3]
    direction = values[:, 4:6].norm(dim=1)
    on_ring = (direction > 0.9) & (ring < EYE_RIM)
    upper = _sector(turn, 0.02, 0.46)
    lower = _sector(turn, 0.54, 0.94)
    amount = upper * _band(ring, _UPPER_LID) + lower * _band(ring, _LOWER_LID)
    return on_ring * amount * _dashed(turn, _LID_DASHES, _LID_SHARE)


def _sector(turn: Tensor, start: float, end: float) -> Tensor:
    return ramp(turn, start - 0.01, start + 0.01) * (1 - ramp(turn, end - 0.01, end + 0.01))


def _lip_dashes(values: Tensor) -> Tensor:
    ring = values[:, 6]
    return (ring < MOUTH_BORDER) * _band(ring, _LIPS) * _dashed(values[:, 7], _LIP_DASHES, _LIP_SHARE)
