"""Two people before one camera, of whom the second passes in front of the first: rendered embedded performers."""

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from torchface import BlendshapeRig
from torchface.geometry.cameras.pinhole import look_at
from torchface.rendering.clay_shading import Lighting, render
from torchface.synthetic import IDENTITY, performer

_WALL = (0.3, 0.35, 0.4)
_KEY = (0.0, 1.0, 0.0)  # behind a head that is put before a wall afterwards
_SIDE = 150  # pixels a side of a head's picture


@dataclass(frozen=True, eq=False)
class CrossingFilm:
    """Frames uint8 (T,3,240,400) and where the middle of the followed face's landmarks is, column (T,) pixels."""

    frames: Tensor
    columns: Tensor


def crossing_film(
    before: int = 20, hidden: float = 0.4, after: int = 20, tint: tuple[float, ...] = (0.5, 0.42, 0.4),
    start: float = 240.0, end: float = 10.0, larger: float = 1.1, stays: float = 0.0, fps: int = 30,
) -> CrossingFilm:  # fmt: skip
    """The first person sits still, alone at first; the second comes, passes in front and stays at the other side.

    Args:
        before: frames in which both are apart, at first, of which a quarter shows the first person alone; ``after``, at
            last.
        hidden: seconds for which the second's head covers the first's in part or whole.
        tint: of the second person's colours beside the first's.
        start: left border of the second's picture at first, pixels, 400 for beyond the picture; ``end``, at last.
        larger: the second's head beside the first's.
        stays: seconds for which the second stands right before the first.
        fps: frames a second.
    """
    first, column = _head(True, (1.0, 1.0, 1.0), 1.0)
    second, _ = _head(False, tint, larger)
    left = 120
    head = 100 * (1 + larger) / 2  # pixels: while it is nearer than that to the first, it covers it
    step = 2 * head / (hidden * fps)
    there = left - _SIDE * (larger - 1) / 2
    passing = torch.arange(start, end, -step)
    waiting = torch.full((round(stays * fps),), there)
    parts = [passing[passing >= there], waiting, passing[passing < there]]
    path = torch.cat([torch.full((before,), start), *parts, torch.full((after,), end)]).round()
    wall = (255 * torch.tensor(_WALL)).byte()[:, None, None].expand(3, 240, 1000)
    frames = []
    for number, place in enumerate(path.long().tolist()):
        frame = wall.clone()
        for (colors, shown), at in ((first, left), (second, place))[: 1 if number < before // 4 else 2]:
            top = (240 - colors.shape[1]) // 2
            region = frame[:, top : top + colors.shape[1], 300 + at : 300 + at + colors.shape[2]]
            region[:, shown] = colors[:, shown]
        frames.append(frame[:, :, 300:700])
    return CrossingFilm(torch.stack(frames), torch.full((len(frames),), left + column))


@cache
def _person(first: bool) -> BlendshapeRig:
    if first:
        return performer(torch.zeros(len(IDENTITY)))
    person = torch.linspace(-1.5, 1.5, len(IDENTITY))
    return performer(person[torch.randperm(len(IDENTITY), generator=torch.Generator().manual_seed(1))])


@cache
def _head(first: bool, tint: tuple[float, ...], scale: float) -> tuple[tuple[Tensor, Tensor], float]:
    """A head's picture uint8 (3,S,S) and the pixels that show it; the middle of its landmarks, column."""
    rig, side = _person(first), round(_SIDE * scale)
    marks = rig.neutral.landmarks
    camera = look_at(rig.vertices[marks].double().mean(0), 0.0, 0.0, 330.0, side, side)
    light = Lighting(occlusion_rays=0)
    on_key, on_wall = (
        render(rig.neutral, camera, background=color, lighting=light, samples=1) for color in (_KEY, _WALL)
    )
    colors = (on_wall * torch.tensor(tint)[:, None, None]).clamp(0, 1)
    column = float(camera.project(rig.vertices[marks].double())[:, 0].mean())
    return ((255 * colors).byte(), (on_key - on_wall).abs().amax(0) < 0.01), column
