"""The colour of a head's surface, decided at points of the mean head, so that no texture is needed."""

import torch
from torch import Tensor

from torchface.synthetic.head.identity import ramp
from torchface.synthetic.head.signed_distance import EYE_CENTRE
from torchface.synthetic.head.skin_texture import blob, brow_line, mix, noise

from .head_kind import EYEBALL, GUMS, TEETH
from .looks import Looks

_GUMS = (0.62, 0.33, 0.32)
_LOWER_ENDS, _BROW_HEIGHT = 3.5, 20.0  # millimetres
_DEEP = (0.10, 0.035, 0.035)


def surface_color(points: Tensor, marks: Tensor, material: Tensor, looks: Looks, brow_lift: float) -> Tensor:
    """sRGB colours (R,3) of points on the performer's sculpture, (R,3), millimetres, with marks (R,8) and a material
    (R,)."""
    points = points.float()
    color = _skin(points, marks, looks, brow_lift)
    teeth = torch.tensor([0.88, 0.84, 0.76]) * (0.75 + 0.35 * ((looks.seed % 97) / 97))
    color[material == TEETH] = teeth
    gums = torch.tensor(_GUMS) * (0.8 + 0.25 * noise(points, 6.0, looks.seed)[:, None])
    color = torch.where((material == GUMS)[:, None], gums, color)
    ball = material == EYEBALL
    color[ball] = _eye(points[ball], looks)
    return color.clamp(0.005, 0.99)


def hair_color(points: Tensor, looks: Looks) -> Tensor:
    """sRGB colours (R,3) of points (R,3) of hair, streaked along its fall, or of a cap."""
    if looks.hat is not None:
        return looks.hat * (0.92 + 0.1 * noise(points.float(), 2.0, looks.seed)[:, None])
    streaks = noise(points.float() * torch.tensor([2.5, 0.25, 1.6]), 1.5, looks.seed + 3)
    broad = noise(points.float() * torch.tensor([1.0, 0.2, 0.8]), 7.0, looks.seed + 4)
    return looks.hair * (0.85 + 0.4 * streaks + 0.3 * broad)[:, None].clamp(0.25, 1.9)


def brow_edge_height(x: Tensor, looks: Looks, brow_lift: float) -> Tensor:
    """How high the brows' upper edge lies on the mean head at distances from its middle (N,), millimetres."""
    middle, half = _brow_line(x, looks)
    return middle + 0.5 * half * looks.brow[1] + brow_lift


def _brow_line(x: Tensor, looks: Looks) -> tuple[Tensor, Tensor]:
    """Someone's brows: the performer's with lower ends, as photographed people have them, more or less arched."""
    middle, half = brow_line(x)
    _, _, arch, shift = looks.brow
    middle = _BROW_HEIGHT + arch * (middle - _BROW_HEIGHT) - _LOWER_ENDS * ((x - 29.5) / 20.5).square().clamp(max=1.3)
    return middle + shift, half


def _skin(p: Tensor, marks: Tensor, looks: Looks, brow_lift: float) -> Tensor:
    lips, mouth, depth, socket, lash, _, nostril, ear = marks.unbind(1)
    seed = looks.seed
    broad, fine, pores = noise(p, 16.0, seed), noise(p, 4.5, seed + 1), noise(p, 1.1, seed + 2)
    color = looks.skin.expand(len(p), 3).clone()
    flushed = (looks.skin * torch.tensor([0.97, 0.68, 0.66])).tolist()
    red = 0.55 * blob(p, (40, -30, 62), (22, 18, 30)) + 0.4 * blob(p, (3, -36, 108), (15, 10, 14))
    red += 0.3 * blob(p, (0, -100, 88), (22, 12, 20)) + 0.35 * ear + 0.2 * broad.clamp(min=0) + 0.1 * fine
    color = mix(color, tuple(flushed), (0.25 + 0.75 * looks.redness) * red)
    dark = 0.5 * blob(p, (29, -11, 76), (14, 5.5, 14)) + 0.45 * blob(p, (22, 6, 80), (10, 7, 14))
    color = mix(color, tuple((0.62 * looks.skin).tolist()), looks.shadows * dark)
    color = color * (1 + 0.05 * broad + 0.04 * fine + 0.05 * pores)[:, None]
    if looks.freckles:
        spots = ramp(noise(p, 1.3, seed + 5) + 0.35 * noise(p, 5.0, seed + 6), 0.6, 0.9)
        color = mix(
            color, tuple((0.6 * looks.skin).tolist()), looks.freckles * spots * blob(p, (22, -18, 82), (40, 30, 40))
        )
    color = _lines(p, color, looks)
    color = mix(color, tuple(looks.shadow_color.tolist()), looks.shadow * blob(p, (31, 8, 80), (13, 6, 16)))
    color = _hair_of_the_face(p, color, marks, looks)
    color = _brows(p, color, looks, brow_lift)
    tone = looks.lips * (1 + 0.1 * noise(p * torch.tensor([4.0, 0.7, 0.7]), 2.2, seed + 7))[:, None]
    color = color + (tone - color) * (0.85 * ramp(lips, 0.25, 0.85))[:, None]
    inside = torch.maximum(mouth, ((lips > 0.9) & (depth > 0.05)).float() * 0.7)
    color = mix(
        color, tuple((0.55 * looks.lips + torch.tensor([0.06, 0.0, 0.0])).tolist()), ramp(inside, 0.3, 1.0) * 0.9
    )
    color = mix(color, _DEEP, depth**0.7 * ramp(mouth, 0.5, 1.0))
    color = mix(color, tuple((0.85 * looks.skin * torch.tensor([1.0, 0.75, 0.72])).tolist()), ramp(socket, 0.2, 0.8))
    dark_rim = (0.35 + 0.65 * looks.liner) * (1.0 if looks.lashes or looks.liner else 0.6)
    color = mix(color, (0.06, 0.045, 0.04), dark_rim * ramp(lash, 0.15, 0.9) * (1 - 0.7 * socket))
    return mix(color, tuple((0.22 * looks.skin).tolist()), 0.85 * nostril)


def _lines(p: Tensor, color: Tensor, looks: Looks) -> Tensor:
    """Wrinkles of the forehead, beside the eyes, and from nose to mouth."""
    if looks.wrinkles < 0.05:
        return color
    x, y = p[:, 0].abs(), p[:, 1]
    wave = (y * 0.62 + 1.2 * noise(p, 12.0, looks.seed + 8)).sin()
    forehead = ramp(wave, 0.6, 1.0) * blob(p, (0, 48, 90), (38, 16, 40))
    fold = torch.exp(-(((x - (20 + 0.32 * (-38 - y))) / 1.6) ** 2)) * ramp(-y, 36, 44) * (1 - ramp(-y, 62, 72))
    feet = ramp(((y + 2 + 0.1 * x) * 1.3).sin(), 0.5, 1.0) * blob(p, (53, 0, 62), (7, 9, 18))
    dark = tuple((0.6 * looks.skin).tolist())
    return mix(color, dark, looks.wrinkles * (0.55 * forehead + 0.7 * fold + 0.6 * feet) * (p[:, 2] > 30))


def brow_share(p: Tensor, looks: Looks, brow_lift: float) -> Tensor:
    """How dense someone's brows are at points (N,3) of the mean head, (N,), between their strokes too."""
    density, thickness, *_ = looks.brow
    x, y = p[:, 0].abs(), p[:, 1] - brow_lift
    along = (x - 9.0) / 41.0
    middle, half = _brow_line(x, looks)
    inside = 1 - ramp((y - middle).abs() / (half * thickness), 0.55, 1.15)
    ends = ramp(along, -0.05, 0.08) * (1 - ramp(along, 0.9, 1.04))
    return density * 1.15 * inside * ends * (p[:, 2] > 40)


def _brows(p: Tensor, color: Tensor, looks: Looks, brow_lift: float) -> Tensor:
    x, y = p[:, 0].abs(), p[:, 1] - brow_lift
    along = (x - 9.0) / 41.0
    lean = 0.9 - 0.6 * along.clamp(0, 1)
    stroke = torch.stack([(x - y * (1 - lean)) * 2.6, (y + x * (1 - lean)) * 0.45, p[:, 2] * 0.3], dim=1)
    hair = 0.72 + 0.4 * noise(stroke, 0.9, looks.seed + 9)
    share = (brow_share(p, looks, brow_lift) * hair).clamp(0, 0.95)
    return mix(color, tuple((0.75 * looks.hair).tolist()), share)


def _hair_of_the_face(p: Tensor, color: Tensor, marks: Tensor, looks: Looks) -> Tensor:
    if not (looks.beard or looks.moustache or looks.stubble):
        return color
    lips = (marks[:, 0] > 0.25) | (marks[:, 1] > 0.3)
    area, upper = _beard_areas(p, looks)
    strands = 0.75 + 0.45 * noise(p * torch.tensor([2.5, 0.9, 2.0]), 1.3, looks.seed + 11)
    amount = torch.maximum(looks.beard * area, looks.moustache * upper) * strands
    amount = torch.maximum(amount, 0.5 * looks.stubble * torch.maximum(area, upper))
    return mix(color, tuple((0.85 * looks.hair).tolist()), 0.9 * amount * ~lips)


def beard_share(p: Tensor, looks: Looks) -> Tensor:
    """How dense someone's beard and moustache are at points (N,3) of the mean head, (N,), stubble left out."""
    area, upper = _beard_areas(p, looks)
    return torch.maximum(looks.beard * area, looks.moustache * upper)


def _beard_areas(p: Tensor, looks: Looks) -> tuple[Tensor, Tensor]:
    """Of beards and of moustaches, (N,) each."""
    x, y, z = p[:, 0].abs(), p[:, 1], p[:, 2]
    edge = -62.0 + 0.012 * (x - 20).clamp(min=0) ** 2 - 4 + 6 * noise(p, 9.0, looks.seed + 10)
    area = ramp(edge - y, 0, 9) * ramp(z, -5, 15) * ramp(y, -140, -118)
    return area, ramp(-44.5 - y, 0, 5) * (1 - ramp(-y, 68, 76)) * (1 - ramp(x, 26, 34)) * ramp(z, 60, 75)


def _eye(p: Tensor, looks: Looks) -> Tensor:
    """Sclera, iris and pupil of an eyeball of the mean head."""
    offset = torch.cat([p[:, :1].abs(), p[:, 1:]], dim=1) - torch.tensor(EYE_CENTRE)
    polar = torch.acos(torch.nn.functional.normalize(offset, dim=1)[:, 2].clamp(-1, 1))
    angle = torch.atan2(offset[:, 1], offset[:, 0])
    white = 0.6 + 0.26 * ((looks.seed % 31) / 31)
    color = torch.tensor((white, 0.965 * white, 0.935 * white)).expand(len(p), 3).clone()
    color = mix(color, (0.74, 0.5, 0.46), 0.6 * ramp(polar, 0.7, 1.5))
    spokes = torch.stack([angle.cos() * 9, angle.sin() * 9, polar * 2.5], dim=1)
    iris = looks.iris * (1 + 0.4 * noise(spokes, 1.0, looks.seed + 12))[:, None]
    iris = mix(iris, (0.05, 0.04, 0.04), ramp(polar, 0.35, 0.46) * 0.8)
    color = color + (iris - color) * (1 - ramp(polar, 0.435, 0.49))[:, None]
    pupil = 0.13 + 0.09 * ((looks.seed % 17) / 17)
    return mix(color, (0.012, 0.012, 0.012), 1 - ramp(polar, pupil - 0.02, pupil + 0.02))
