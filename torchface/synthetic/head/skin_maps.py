"""Skin, eyes, teeth and hair of a character as images: colour, normals in tangent space, roughness."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.geometry.meshes.normal_maps import SurfaceMaps
from torchface.geometry.meshes.rasterization import TexelMap
from torchface.synthetic.head.hair import HAIR_PATCH, flow, hair_share
from torchface.synthetic.head.hair_locks import LOCK_PATCH, Style, strand_shade
from torchface.synthetic.head.identity import ramp, sculpted_vertices
from torchface.synthetic.head.shirt import SHIRT_PATCH, cloth
from torchface.synthetic.head.skin_texture import (
    blob,
    brow_line,
    eye_color,
    inner_color,
    mix,
    noise,
    skin_color,
    texel_values,
    vertex_marks,
)
from torchface.synthetic.head.teeth_and_tongue import PAGE, TEETH

_MELANIN = (1.9, 2.2, 2.4)
_MARGIN = 6  # texels round a part's rectangle
_PIECE, _ROWS = 2**14, 16  # points, rows
_WING = ((15.6, -28.6, 91.2), (17.6, -32.0, 87.8), (18.4, -38.5, 86.2), (16.8, -44.0, 87.0))
"""Along the groove between the nose's wing and the cheek, on the left."""


@dataclass(frozen=True)
class Look:
    """What a person looks like beside the form of the head.

    Args:
        melanin: pigment of the skin, from 0, northern European, to 1, the darkest.
        age: of the skin, years.
        hair, iris, shirt: sRGB in [0,1].
        lips: how much redder than the skin the lips are, 1 as usual.
        freckles: how strong they are, 1 as usual.
        teeth, whites: how bright teeth and the whites of the eyes are, 1 as usual.
        iris_size: how wide irises are on their eyeballs, 1 as usual.
        haircut: "short", "long" to the shoulders, or "tied" at the back; bald if absent.
        fringe: whether hair hangs over the forehead, down to the brows.

    Example:
        >>> Look(age=70.0, hair=(0.6, 0.6, 0.6)).melanin
        0.0
    """

    melanin: float = 0.0
    age: float = 30.0
    hair: tuple[float, float, float] = (0.20, 0.135, 0.09)
    iris: tuple[float, float, float] = (0.33, 0.24, 0.14)
    lips: float = 1.0
    freckles: float = 1.0
    haircut: Style | None = "short"
    fringe: bool = False
    shirt: tuple[float, float, float] = (0.23, 0.28, 0.34)
    teeth: float = 1.0
    whites: float = 1.0
    iris_size: float = 1.0


@dataclass(frozen=True, eq=False)
class SkinMaps:
    """Images in the head's layout, first row on top: colour (3,H,W), and how the surface shades."""

    color: Tensor
    surface: SurfaceMaps


def skin_maps(look: Look, size: int = 2048, skin: Tensor | None = None) -> SkinMaps:
    """The images of a person, with skin (3,size,size), such as of a fit to photographs, in place of the look's."""
    return _look_maps(look, size) if skin is None else _maps(look, size, skin)


@lru_cache(maxsize=4)
def _look_maps(look: Look, size: int) -> SkinMaps:
    return _maps(look, size, None)


def _maps(look: Look, size: int, skin: Tensor | None) -> SkinMaps:
    texels, p, marks = _texels(size)
    bare = torch.empty(len(p), 0) if skin is None else skin.flatten(1)[:, texels.texels].T.float()
    # All is decided point by point: a few at once stay in the processor's cache, in a third of the time.
    pieces = [_painted(look, *piece) for piece in zip(*(one.split(_PIECE) for one in (p, marks, bare)), strict=True)]
    color, rough, height = (torch.cat(parts) for parts in zip(*pieces, strict=True))
    images = texels.image(torch.cat([color, rough[:, None]], 1))
    color_image, rough_image = images[:3], images[3:]
    normals = _normals(texels, p, height)
    _paint_parts(color_image, rough_image, normals, look)
    return SkinMaps(color_image, SurfaceMaps(normals, rough_image))


def _painted(look: Look, p: Tensor, marks: Tensor, bare: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (N,3), the skin's own or the look's, roughness (N,) and relief (N,) at points (N,3) with marks (N,8)."""
    lips, mouth, _, socket, lash, eyeball, nostril, ear = marks.unbind(1)
    hair = hair_share(p) * (1 - ear) * (1 - ramp(eyeball + socket + mouth, 0.2, 0.5))
    hair = hair if look.haircut else torch.zeros_like(hair)
    ball = eyeball > 0.5
    old = max(0.0, (look.age - 32.0) / 40.0)
    creases, groove = _creases(p) * old, _wing_groove(p)
    if bare.shape[1] == 0:
        color = _pigmented(skin_color(p, marks, look.freckles, 0.75 * look.lips), look.melanin)
        color = color * (1 - 0.22 * creases.clamp(0, 1))[:, None]
        color = mix(color, (0.42, 0.27, 0.19), 0.35 * min(old, 1.0) * ramp(noise(p, 3.2, 41), 0.62, 0.85))
        color = mix(color, look.hair, 0.42 * _brow_shade(p))
        color = color * (1 - torch.tensor([0.10, 0.16, 0.17]) * groove[:, None])
    else:
        color = bare
    strand = _strands(p)
    tone = torch.tensor(look.hair) * (0.92 + 0.42 * strand)[:, None]
    root = 0.62 + 0.38 * ramp(hair, 0.05, 0.5)
    shown = ramp(hair + 0.12 * strand * ramp(hair, 0.0, 0.15), 0.0, 0.30) * root
    color = color + (tone - color) * (0.94 * shown).clamp(0, 1)[:, None]
    color = inner_color(color, marks)
    color[ball] = eye_color(p[ball], look.iris, look.whites, look.iris_size)
    height = _height(p, lips, hair, strand, old) - 0.30 * creases - 0.9 * groove
    height = height + _neck(p) * (1 - ramp(hair, 0.0, 0.3))
    height = height * (1 - ramp(eyeball + socket + mouth + nostril, 0.1, 0.4))
    return color.clamp(0, 1), _roughness(p, lips, mouth, hair, lash, ball), height


@lru_cache(maxsize=1)
def _texels(size: int) -> tuple[TexelMap, Tensor, Tensor]:
    """Texels of the skin's page, the sculpture's points there (M,3) and their marks (M,8)."""
    texels, values = texel_values(size, torch.cat([sculpted_vertices().float(), vertex_marks()], 1))
    return texels, values[:, :3].contiguous(), values[:, 3:]


def _pigmented(color: Tensor, melanin: float) -> Tensor:
    """Colours (M,3) under more pigment, as it absorbs in linear light."""
    return to_srgb(to_linear(color.clamp(0, 1)) * torch.exp(-melanin * torch.tensor(_MELANIN)))


def _strands(p: Tensor) -> Tensor:
    """Light and dark of single hairs along the hair's flow, (M,) in about [-1,1]."""
    f = flow(p)
    bent = f[:, 0] + 5.0 * noise(p, 22.0, 23)
    at = torch.stack([bent, 0.05 * f[:, 1], 0 * bent], 1)
    return 0.6 * noise(at, 0.75, 26) + 0.5 * noise(at, 2.2, 25)


def _brow_shade(p: Tensor) -> Tensor:
    """Share of the brows' shade under their hairs, soft."""
    x, y = p[:, 0].abs(), p[:, 1]
    middle, half = brow_line(x)
    ends = ramp(x, 7.0, 15.0) * (1 - ramp(x, 42.0, 51.0))
    return (1 - ramp((y - middle).abs() / half, 0.2, 1.35)) * ends * (p[:, 2] > 40)


def _creases(p: Tensor) -> Tensor:
    """How deep the lines of age are, (M,): forehead, between the brows, crow's feet, from nose to mouth, cheeks."""
    x, y = p[:, 0].abs(), p[:, 1]
    wave = 1.6 * noise(p, 14.0, 42)
    line = lambda distance, width: torch.exp(-((distance / width) ** 2))  # noqa: E731
    forehead = sum(line(y + wave - at - 0.0022 * x**2, 0.9) for at in (32.0, 39.5, 47.5))
    total = 0.8 * torch.as_tensor(forehead) * (1 - ramp(x, 26, 44)) * (p[:, 2] > 50)
    total = total + 0.8 * line(x - 5.5 - 0.05 * (y - 16) + 0.4 * wave, 0.9) * ramp(y, 8, 13) * (1 - ramp(y, 22, 29))
    bearing = torch.atan2(y - 1.0, (x - 44.0).clamp(min=0.1))
    away = torch.hypot(x - 44.0, y - 1.0)
    feet = line(torch.sin(bearing * 7.5 + 0.5 * wave) - 1, 0.5) * ramp(away, 4, 8) * (1 - ramp(away, 13, 21)) * (x > 45)
    fold = line(x - (17.0 + 13.0 * ramp(-y, 38, 68)) + 0.5 * wave, 1.8) * ramp(-y, 36, 46) * (1 - ramp(-y, 62, 74))
    under = line(y + 14.5 - 0.012 * (x - 29) ** 2 + 0.5 * wave, 1.0) * (1 - ramp((x - 29).abs(), 8, 15))
    return total + 0.7 * feet + 1.4 * fold * (p[:, 2] > 50) + 0.6 * under * (p[:, 2] > 50)


def _wing_groove(p: Tensor) -> Tensor:
    """How deep the grooves about the nose's wings are, (M,) in [0,1]."""
    line = torch.tensor(_WING)
    folded = torch.cat([p[:, :1].abs(), p[:, 1:]], 1)[:, None]
    start, way = line[:-1], line.diff(dim=0)
    along = (((folded - start) * way).sum(-1) / way.square().sum(-1)).clamp(0, 1)
    apart = (folded - start - along[..., None] * way).norm(dim=-1).amin(1)
    return torch.exp(-((apart / 2.2) ** 2))


def _height(p: Tensor, lips: Tensor, hair: Tensor, strand: Tensor, old: float) -> Tensor:
    """Relief of the skin, millimetres."""
    oily = blob(p, (12, -34, 100), (18, 18, 26)) + 0.7 * blob(p, (30, -34, 72), (20, 18, 26))
    pores = ramp(noise(p, 0.75, 31), 0.15, 0.8)
    relief = -0.07 * pores * (0.35 + oily) + 0.035 * noise(p, 0.5, 32) + 0.05 * (1 + old) * noise(p, 1.5, 33)
    lip = noise(p * torch.tensor([4.0, 0.7, 0.7]), 3.2, 6)
    red = ramp(lips, 0.3, 0.9)
    return (relief * (1 - red) - 0.16 * lip.abs() * red) * (1 - ramp(hair, 0.05, 0.4)) + 0.34 * strand * ramp(
        hair, 0, 0.4
    )


def _neck(p: Tensor) -> Tensor:
    """Relief of the throat, millimetres, (M,): the muscle from the ear to the breastbone, the larynx, the windpipe."""
    folded = torch.cat([p[:, :1].abs(), p[:, 1:]], 1)
    start, end = torch.tensor([[50.0, -48.0, -24.0], [11.0, -168.0, 24.0]])
    along = ((folded - start) @ (end - start) / (end - start).square().sum()).clamp(0, 1)
    apart = (folded - start - along[:, None] * (end - start)).norm(dim=1)
    muscle = 5.0 * torch.exp(-((apart / 8.5) ** 2)) * ramp(along, 0.05, 0.3)
    front = (p[:, 2] > -20) * ramp(-p[:, 1], 96, 108)
    larynx = 4.5 * torch.exp(-((p[:, 0] / 8.0) ** 2) - ((p[:, 1] + 124) / 10.0) ** 2)
    windpipe = 1.6 * torch.exp(-((p[:, 0] / 11.0) ** 2)) * ramp(-p[:, 1], 118, 140)
    return muscle + (larynx + windpipe) * front


def _roughness(p: Tensor, lips: Tensor, mouth: Tensor, hair: Tensor, lash: Tensor, ball: Tensor) -> Tensor:
    rough = 0.60 - 0.14 * blob(p, (4, -20, 100), (14, 26, 26)) - 0.08 * blob(p, (0, 40, 92), (34, 20, 40))
    rough = rough + 0.05 * noise(p, 2.0, 34)
    for share, value in ((ramp(lips, 0.3, 0.9), 0.42), (ramp(hair, 0.0, 0.3), 0.62), (ramp(mouth, 0.3, 0.9), 0.35),
                         (ramp(lash, 0.15, 0.35), 0.12), (ball.float(), 0.12)):  # fmt: skip
        rough = rough + (value - rough) * share
    return rough.clamp(0.05, 1)


def _normals(texels: TexelMap, p: Tensor, height: Tensor) -> Tensor:
    """Unit normals (3,H,W) of a relief (M,), millimetres, over the sculpture's points (M,3)."""
    table = torch.zeros(texels.height * texels.width, 5)
    table[texels.texels] = torch.cat([p, height[:, None], torch.ones(len(p), 1)], 1)
    image = table.view(texels.height, texels.width, 5)
    wrapped, normals = torch.cat([image[-1:], image, image[:1]]), torch.empty(3, *image.shape[:2])
    for first in range(0, len(image), _ROWS):  # as `_PIECE`
        near = wrapped[first : first + _ROWS + 2]
        here = near[1:-1]
        right, down = _slope(here, here.roll(1, 1), here.roll(-1, 1)), _slope(here, near[:-2], near[2:])
        piece = torch.stack([-right, down, torch.ones_like(right)])
        normals[:, first : first + len(here)] = torch.nn.functional.normalize(piece, dim=0)
    return normals


def _slope(here: Tensor, back: Tensor, ahead: Tensor) -> Tensor:
    """How steep the relief is from one texel to another, (R,W), both beside those of ``here``."""
    step = (ahead[..., :3] - back[..., :3]).norm(dim=-1).clamp(min=0.05)
    inside = (ahead[..., 4] * back[..., 4] * here[..., 4]) > 0
    return torch.where(inside & (step < 6), (ahead[..., 3] - back[..., 3]) / step, 0.0)


def _paint_parts(color: Tensor, rough: Tensor, normals: Tensor, look: Look) -> None:
    """Teeth, gums, tongue and single hairs on their rectangles of the page; coordinates run right and up in them."""
    size = color.shape[1]
    for name, (left, low, right, high) in {
        **PAGE,
        "hair": HAIR_PATCH,
        "locks": LOCK_PATCH,
        "shirt": SHIRT_PATCH,
    }.items():
        rows = torch.arange(int((1 - high) * size) - _MARGIN, int((1 - low) * size) + _MARGIN)
        columns = torch.arange(int(left * size) - _MARGIN, int(right * size) + _MARGIN)
        v = ((1 - (rows + 0.5) / size - low) / (high - low)).clamp(0, 1)[:, None].expand(-1, len(columns))
        u = (((columns + 0.5) / size - left) / (right - left)).clamp(0, 1)[None].expand(len(rows), -1)
        at = torch.stack([u.flatten(), v.flatten(), torch.zeros(u.numel())], 1)
        paint = _PART_PAINT[name](at, look)
        color[:, rows[:, None], columns] = paint.T.view(3, *u.shape).clamp(0, 1)
        if name == "locks":  # strands catch the light one by one
            shade = paint.mean(1).view(u.shape)
            tilt = 1.1 * torch.gradient(shade / shade.mean(), dim=1)[0]
            bent = torch.stack([-tilt, 0 * tilt, torch.ones_like(tilt)])
            normals[:, rows[:, None], columns] = torch.nn.functional.normalize(bent, dim=0)
        rough[:, rows[:, None], columns] = {
            "teeth": 0.2,
            "gums": 0.3,
            "tongue": 0.4,
            "hair": 0.6,
            "locks": 0.58,
            "shirt": 0.9,
        }[name]


# Cheeks keep the light from teeth far back; from the middle incisor to the second molar.
_LIGHT_ON_TEETH = (1.0, 0.99, 0.95, 0.82, 0.62, 0.42, 0.3)


def _teeth(at: Tensor, look: Look) -> Tensor:
    v = at[:, 1]
    yellow = min(1.0, max(0.0, (look.age - 25) / 60))
    color = mix(
        torch.tensor((0.90, 0.87, 0.81)).expand(len(at), 3),
        (0.80, 0.70, 0.52),
        (0.35 + 0.5 * yellow) * (1 - ramp(v, 0.1, 0.7)),
    )
    color = mix(color, (0.84, 0.85, 0.86), 0.5 * ramp(v, 0.85, 1.0))
    number = (at[:, 0] * TEETH).long().clamp(max=TEETH - 1)
    color = color * torch.tensor(_LIGHT_ON_TEETH)[number][:, None]
    return look.teeth * mix(color, (0.80, 0.72, 0.58), 0.15 * yellow * torch.ones(len(at)))


def _gums(at: Tensor, look: Look) -> Tensor:
    del look
    color = torch.tensor((0.74, 0.42, 0.41)) * (1 + 0.06 * noise(at * 40, 3.0, 51))[:, None]
    return mix(color, (0.62, 0.28, 0.28), 0.8 * ramp((at[:, 0] - 0.33).abs(), 0.06, 0.5))


def _tongue(at: Tensor, look: Look) -> Tensor:
    del look
    grain = noise(at * torch.tensor([60.0, 90.0, 1.0]), 1.2, 52)
    color = torch.tensor((0.72, 0.39, 0.38)) * (1 + 0.09 * grain)[:, None]
    return mix(color, (0.55, 0.24, 0.24), 0.7 * (1 - ramp(at[:, 1], 0.1, 0.7)))


def _hairs(at: Tensor, look: Look) -> Tensor:
    shade = 0.75 + 0.5 * torch.frac(at[:, 0] * 7.3) + 0.15 * at[:, 1]
    return 1.05 * torch.tensor(look.hair) * shade[:, None]


def _locks(at: Tensor, look: Look) -> Tensor:
    return torch.tensor(look.hair) * strand_shade(at[:, 0], 1 - at[:, 1])[:, None]


def _shirt(at: Tensor, look: Look) -> Tensor:
    return torch.tensor(look.shirt) * cloth(at)[:, None]


_PART_PAINT = {"teeth": _teeth, "gums": _gums, "tongue": _tongue, "hair": _hairs, "locks": _locks, "shirt": _shirt}
