"""Painted skin: colours decided at points of the sculpture, so that no seam shows."""

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from torchface.geometry.meshes.rasterization import TexelMap, rasterise_uvs
from torchface.mesh import fan_triangulation
from torchface.synthetic.head.facial_openings import lid_order
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import both_sides, ramp, sculpted_vertices
from torchface.synthetic.head.signed_distance import EYE_CENTRE
from torchface.synthetic.head.topology import EYE_RIM, MOUTH_BORDER, MOUTH_CONTACT, topology
from torchface.synthetic.head.uv_layout import unwrapping

_SIZE = 1024
SKIN = (0.86, 0.665, 0.565)
LIPS = (0.70, 0.40, 0.37)
HAIR = (0.20, 0.145, 0.115)
_MARKS = 8


@lru_cache(maxsize=2)
def skin_texture() -> Tensor:
    """The skin texture of every performer, (3,1024,1024), first row on top."""
    texels, values = texel_values(_SIZE, torch.cat([sculpted_vertices().float(), vertex_marks()], dim=1))
    return texels.image(_paint(values[:, :3], values[:, 3:]))


def texel_values(size: int, table: Tensor) -> tuple[TexelMap, Tensor]:
    """The M texels of the skin's page, and the values (M,C) there of a table (V,C) of the vertices."""
    flat = unwrapping()
    texels = rasterise_uvs(flat.uvs, fan_triangulation(flat.quads), size, size)
    return texels, texels.interpolate(table, fan_triangulation(topology().quads)).float()


def vertex_marks() -> Tensor:
    """Vertex attributes beside the positions, (V,8).

    They are lips, mouth, depth in it, eye socket, lashes, eyeball, nostril and ear.
    """
    t, regions = topology(), head_annotations().regions
    marks = torch.zeros(t.count, _MARKS)
    lips = torch.tensor([0.0] * (MOUTH_BORDER - 1) + [0.0, 0.55, 1.0, 1.0, 1.0, 1.0] + [1.0] * 7)
    deep = (torch.arange(len(t.rings["mouth"])) - MOUTH_CONTACT).clamp(min=0) / 7
    above, _ = lid_order()
    for side in (0, 1):
        mouth, eye = both_sides(t.rings["mouth"])[side], both_sides(t.rings["eye"])[side]
        marks[mouth, 0] = lips[:, None].expand(-1, 27)
        marks[mouth, 2] = deep[:, None].expand(-1, 27)
        marks[both_sides(t.caps["mouth"])[side], 2] = 1.0
        marks[eye[EYE_RIM + 1 :], 3] = 1.0
        marks[eye[EYE_RIM], 4] = 0.35
        marks[eye[EYE_RIM][above[1:-1]], 4] = 1.0
        marks[eye[EYE_RIM - 1][above[2:]], 4] = 0.25
        marks[both_sides(t.rings["ear"])[side][1:], 7] = 1.0
        marks[both_sides(t.caps["ear"])[side], 7] = 1.0
    marks[:, 1] = regions["mouth_interior"].float()
    marks[regions["eye_sockets"], 3] = 1.0
    marks[regions["eyeball_left"] | regions["eyeball_right"], 5] = 1.0
    marks[regions["nostrils"], 6] = 1.0
    return marks


def noise(points: Tensor, millimetres: float, seed: int) -> Tensor:
    """Smooth random values (N,) in about [-1,1] that change over a length; the same at the same point everywhere."""
    place = points / millimetres / 32 + 0.37  # turns back at the lattice's ends, none of which lies on the midline
    wrapped = (place - 2 * (place / 2).round()).abs() * 2 - 1
    grid = wrapped.view(1, 1, 1, -1, 3)
    return torch.nn.functional.grid_sample(_lattice(seed), grid, padding_mode="border", align_corners=True)[0, 0, 0, 0]


@lru_cache(maxsize=32)
def _lattice(seed: int) -> Tensor:
    return torch.rand(1, 1, 32, 32, 32, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def blob(points: Tensor, centre: tuple[float, float, float], width: tuple[float, float, float]) -> Tensor:
    """A Gaussian (N,) round a point of the left side of the face and its mirror image, falling to 1/e at ``width``."""
    folded = torch.cat([points[:, :1].abs(), points[:, 1:]], dim=1)
    return torch.exp(-(((folded - torch.tensor(centre)) / torch.tensor(width)) ** 2).sum(1))


def mix(color: Tensor, other: tuple[float, ...], share: Tensor) -> Tensor:
    """Colours (N,3) with a share (N,) of another in them."""
    return color + (torch.tensor(other) - color) * share.clamp(0, 1)[:, None]


def _paint(p: Tensor, marks: Tensor) -> Tensor:
    color = skin_color(p, marks)
    fine, pores = noise(p, 4.5, 2), noise(p, 0.9, 3)
    color = mix(color, HAIR, _cropped_hair(p, fine, pores) * (1 - marks[:, 7]))
    color = mix(color, HAIR, _brows(p))
    color = inner_color(color, marks)
    is_ball = marks[:, 5] > 0.5
    color[is_ball] = eye_color(p[is_ball])
    return color.clamp(0, 1)


def skin_color(p: Tensor, marks: Tensor, freckles: float = 1.0, red_lips: float = 1.0) -> Tensor:
    """Colours (N,3) of bare skin and lips at points (N,3) of the sculpture with their marks (N,8)."""
    lips, ear = marks[:, 0], marks[:, 7]
    color = torch.tensor(SKIN).expand(len(p), 3).clone()
    broad, fine, pores = noise(p, 16.0, 1), noise(p, 4.5, 2), noise(p, 0.9, 3)
    red = 0.55 * blob(p, (40, -30, 62), (22, 18, 30)) + 0.4 * blob(p, (3, -36, 108), (15, 10, 14))
    red += 0.3 * blob(p, (0, -100, 88), (22, 12, 20)) + 0.35 * ear + 0.18 * broad.clamp(min=0) + 0.08 * fine
    color = mix(color, (0.76, 0.43, 0.37), 0.62 * red)
    dark = 0.35 * blob(p, (29, -11, 76), (14, 5.5, 14)) + 0.22 * blob(p, (22, 6, 80), (10, 7, 14))
    color = mix(color, (0.53, 0.36, 0.33), 0.75 * dark)
    color = mix(color, (0.87, 0.70, 0.59), 0.35 * blob(p, (0, 45, 92), (34, 18, 40)))
    color = color * (1 + 0.035 * broad + 0.03 * fine + 0.028 * pores)[:, None]
    freckled = blob(p, (22, -18, 82), (28, 14, 30)) + 0.35 * blob(p, (20, 40, 90), (50, 26, 40))
    spots = ramp(noise(p, 1.2, 4) + 0.35 * noise(p, 5.0, 5), 0.66, 1.0)
    color = mix(color, (0.55, 0.34, 0.24), 0.32 * freckles * spots * freckled)
    lip_tone = torch.tensor(LIPS) * (1 + 0.10 * noise(p * torch.tensor([4.0, 0.7, 0.7]), 2.2, 6))[:, None]
    return color + (lip_tone - color) * (0.9 * red_lips * ramp(lips, 0.25, 0.85)).clamp(0, 1)[:, None]


def inner_color(color: Tensor, marks: Tensor) -> Tensor:
    """Colours (N,3) with the mouth's inside, the sockets, the lids' wet edges and the nostrils."""
    mouth, depth, socket, lash, nostril = marks[:, [1, 2, 3, 4, 6]].unbind(1)
    color = mix(color, (0.48, 0.19, 0.18), ramp(mouth, 0.3, 1.0) * 0.9)
    color = mix(color, (0.30, 0.09, 0.09), depth**0.7 * ramp(mouth, 0.5, 1.0))
    color = mix(color, (0.74, 0.46, 0.41), ramp(socket, 0.2, 0.8))
    color = mix(color, (0.12, 0.08, 0.07), 0.9 * lash * (1 - socket))
    return mix(color, (0.22, 0.10, 0.08), 0.92 * nostril)


def brow_line(x: Tensor) -> tuple[Tensor, Tensor]:
    """The height of the brows' middle line and half their thickness, (N,) each, at distances x (N,) from the face's
    middle, millimetres."""
    along = ((x - 9.0) / 41.0).detach().cpu().numpy()
    knots, arch = np.array([0, 0.3, 0.62, 0.82, 1.0]), np.array([18.2, 20.6, 23.0, 21.6, 17.4])
    middle = torch.from_numpy(np.interp(along, knots, arch)).float()
    return middle, torch.from_numpy(np.interp(along, knots, np.array([3.4, 3.7, 3.0, 2.2, 0.9]))).float()


def _brows(p: Tensor) -> Tensor:
    """Share of brow hair: a tapering arch of strokes that lean outward."""
    x, y, z = p[:, 0].abs(), p[:, 1], p[:, 2]
    along = (x - 9.0) / 41.0
    middle, half = brow_line(x)
    inside = 1 - ramp((y - middle).abs() / half, 0.55, 1.15)
    ends = ramp(along, -0.05, 0.08) * (1 - ramp(along, 0.9, 1.04))
    # Strokes: noise drawn out along a direction that rotates from upright to outward.
    lean = 0.9 - 0.6 * along.clamp(0, 1)
    stroke = torch.stack([(x - y * (1 - lean)) * 2.6, (y + x * (1 - lean)) * 0.45, z * 0.3], dim=1)
    hair = 0.68 + 0.42 * noise(stroke, 0.9, 7) + 0.12 * noise(stroke, 2.4, 9)
    return (inside * ends * hair * (z > 40)).clamp(0, 0.92)


def _cropped_hair(p: Tensor, fine: Tensor, pores: Tensor) -> Tensor:
    """Share of hair cropped to the scalp: above a hairline that drops at the temples, round the ears to the nape."""
    x, y, z = p[:, 0].abs(), p[:, 1], p[:, 2]
    line = np.interp(
        z.numpy(), [-200, -70, -30, -14, 8, 20, 34, 48, 62, 90], [-75, -72, -50, -18, -8, 8, 36, 52, 57, 63]
    )
    edge = torch.from_numpy(line).float() + 0.03 * (x - 40).clamp(min=0)
    return 0.66 * ramp(y - edge + 5.0 * fine, -6.0, 11.0) * (0.86 + 0.3 * pores)


IRIS_EDGE = 0.45
"""Half the angle that an iris takes up, seen from the eyeball's middle, radians."""


def eye_color(
    p: Tensor, brown: tuple[float, float, float] = (0.33, 0.24, 0.14), whites: float = 1.0, iris_size: float = 1.0
) -> Tensor:
    """Colours (N,3) of points of an eyeball: sclera with veins, limbal ring, iris of a colour and size, pupil,
    highlight."""
    centre = torch.tensor(EYE_CENTRE)
    offset = torch.cat([p[:, :1].abs(), p[:, 1:]], dim=1) - centre
    way = torch.nn.functional.normalize(offset, dim=1)
    polar = torch.acos(way[:, 2].clamp(-1, 1))
    angle = torch.atan2(offset[:, 1], offset[:, 0])
    color = whites * torch.tensor((0.86, 0.83, 0.80)).expand(len(p), 3)
    veins = ramp(1 - (noise(p * torch.tensor([1.0, 2.2, 1.0]), 2.6, 11).abs() * 6), 0.3, 1.0)
    color = mix(color, (0.78, 0.45, 0.42), 0.16 * veins * ramp(polar, 0.55, 0.9))
    color = mix(color, (0.78, 0.52, 0.48), 0.75 * ramp(polar, 0.75, 1.5))
    color = color * (1 - 0.30 * ramp(way[:, 1], 0.12, 0.42))[:, None]  # the upper lid's shade
    polar = polar / iris_size
    spokes = torch.stack([angle.cos() * 9, angle.sin() * 9, polar * 2.5], dim=1)
    varied = 1.1 - sum(brown) / 3  # light irises are more even
    iris = torch.tensor(brown) * (1 + 0.45 * varied * noise(spokes, 1.0, 8))[:, None]
    light = torch.tensor(brown) * (1 + 0.35 * varied) + 0.03
    iris = iris + (light - iris) * (1 - ramp(polar, 0.17, 0.34))[:, None]
    caustic = ramp(-(way[:, 1] + 0.6 * way[:, 0]), -0.05, 0.35)  # light gathers opposite the highlight
    iris = iris * (1 + 0.75 * varied * (caustic - 0.4))[:, None]
    iris = mix(iris, (0.07, 0.05, 0.045), 0.9 * ramp(polar, 0.36, 0.44))
    color = color + (iris - color) * (1 - ramp(polar, IRIS_EDGE - 0.025, IRIS_EDGE + 0.025))[:, None]
    color = mix(color, (0.015, 0.012, 0.012), 1 - ramp(polar, 0.165, 0.195))
    for x, y, size, strength in ((-0.15, 0.20, 0.075, 0.95), (0.13, -0.17, 0.05, 0.25)):
        glint = way - torch.nn.functional.normalize(torch.tensor([x, y, 0.97]), dim=0)
        color = mix(color, (1.0, 1.0, 1.0), strength * (1 - ramp(glint.norm(dim=1), 0.5 * size, size)))
    return color
