"""The courses along which faces fold, drawn by 68 landmarks with seeded variation, before they lie on the skin."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from torchface.landmarks.images.ibug_68 import MIRROR_68

_INTEROCULAR = 62.0  # millimetres between the eyes' middles that sizes are given for


@dataclass(frozen=True)
class Stroke:
    """A line before it lies on the skin: (K,2) control points in millimetres round the face and up."""

    place: str
    control: Tensor
    depth: float
    width: float
    trace: float = 0.08
    overhang: float = 0.0


def wrinkle_strokes(marks: Tensor, seed: int) -> list[Stroke]:
    """All the strokes of a face, by its 68 landmarks (68,2), millimetres round the face and up."""
    draw = _Draw(torch.Generator().manual_seed(seed))
    scale = float((marks[42:48].mean(0) - marks[36:42].mean(0)).norm()) / _INTEROCULAR
    strokes = [
        *_forehead(marks, scale, draw),
        *_glabella(marks, scale, draw),
        *_nose(marks, scale, draw),
        *_chin(marks, scale, draw),
        *_lips(marks, scale, draw),
    ]
    mirrored = marks[list(MIRROR_68)] * torch.tensor([-1.0, 1.0])
    for side, seen, sign in (("left", marks, 1.0), ("right", mirrored, -1.0)):
        # Drawn as if each side were the left one, from its own random numbers: no face is quite symmetric.
        for stroke in (*_eye(seen, scale, draw), *_nasolabial(seen, scale, draw), *_nose_side(seen, scale, draw)):
            flipped = stroke.control * torch.tensor([sign, 1.0])
            control = flipped if sign > 0 else flipped.flip(0)
            strokes.append(replace(stroke, place=f"{stroke.place}_{side}", control=control))
    return strokes


class _Draw:
    """Random numbers as the strokes need them."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def between(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def wave(self, count: int, size: float) -> Tensor:
        """A slow random course along a line, (count,)."""
        along = torch.linspace(0, 1, count)
        return sum(
            (
                self.between(-size, size) / k * (2 * math.pi * (0.7 * k * along + self.between(0, 1))).sin()
                for k in range(1, 4)
            ),
            start=torch.zeros(count),
        )


def _forehead(marks: Tensor, scale: float, draw: _Draw) -> Iterator[Stroke]:
    brow = marks[17:27]
    height, reach = float(brow[:, 1].mean()), float(brow[:, 0].abs().amax())
    level = height + 9.0 * scale
    row = 0
    while level < height + 41.0 * scale:
        spacing = draw.between(4.6, 6.6) * scale
        middle = 1 - abs(level - height - 24 * scale) / (34 * scale)
        # Furrows are broken: one, two or three pieces that overlap a little and do not quite meet.
        cuts = [-1.0, *sorted(draw.between(-0.5, 0.5) for _ in range(row % 3)), 1.0]
        for start, end in pairwise(cuts):
            low, high = (start - draw.between(0.0, 0.06)) * reach, (end + draw.between(0.0, 0.06)) * reach
            low, high = max(low, -reach * draw.between(0.78, 0.98)), min(high, reach * draw.between(0.78, 0.98))
            if high - low < 12 * scale:
                continue
            across = torch.linspace(low, high, 14)
            arch = _brow_arch(across / reach) * scale
            up = level + arch + draw.between(-0.9, 0.9) * scale + draw.wave(14, 1.1 * scale)
            deep = draw.between(0.7, 1.05) * (0.55 + 0.45 * middle)
            yield Stroke("forehead", torch.stack([across, up], 1), deep, spacing / 2, draw.between(0.05, 0.14))
        for _ in range(2):
            start = draw.between(-0.8, 0.5) * reach
            across = torch.linspace(start, start + draw.between(12, 26) * scale, 8)
            arch = _brow_arch(across / reach) * scale
            up = level + arch + spacing * draw.between(0.4, 0.6) + draw.wave(8, 0.8 * scale)
            yield Stroke("forehead", torch.stack([across, up], 1), draw.between(0.15, 0.35), spacing / 4)
        level += spacing
        row += 1


def _brow_arch(across: Tensor) -> Tensor:
    """Millimetres by which furrows rise over each brow and dip between; -1 and 1 are the brows' outer ends."""
    return 1.6 * (1 - (2 * math.pi * across).cos())


def _glabella(marks: Tensor, scale: float, draw: _Draw) -> Iterator[Stroke]:
    inner, root = marks[[21, 22]], marks[27]
    height, half = float(inner[:, 1].mean()), float(inner[:, 0].abs().mean())
    for position, deep, long in ((-0.74, 1.0, 1.0), (-0.3, 0.4, 0.45), (0.2, 0.35, 0.3), (0.7, 0.95, 0.85)):
        top = height + (2 + draw.between(6, 11) * long) * scale
        bottom = float(root[1]) + (draw.between(1, 3) + 5 * (1 - long)) * scale
        up = torch.linspace(bottom, top, 10)
        along = torch.linspace(0, 1, 10)
        lean = half * (position + draw.between(-0.08, 0.08)) * (0.72 + 0.5 * along.square())
        course = torch.stack([lean + draw.wave(10, 0.5 * scale), up], 1)
        yield Stroke("glabella", course, deep * draw.between(0.8, 1.1), 2.2 * scale, draw.between(0.06, 0.14))


def _nose(marks: Tensor, scale: float, draw: _Draw) -> Iterator[Stroke]:
    """Lines across the root, where the brows come down."""
    root = marks[27]
    for rise in (-1.5, 1.6, 4.6):
        half = draw.between(5.5, 8.5) * scale
        across = torch.linspace(-half, half, 9)
        up = root[1] + (rise + draw.between(-0.4, 0.4)) * scale - 1.2 * scale * (across / half).square()
        yield Stroke(
            "nose_root", torch.stack([across, up + draw.wave(9, 0.25)], 1), draw.between(0.35, 0.6), 1.5 * scale
        )


def _nose_side(marks: Tensor, scale: float, draw: _Draw) -> Iterator[Stroke]:
    """Bunny lines: from the bridge's side down and outward to the inner cheek."""
    bridge = (marks[27] + marks[28]) / 2
    for k in range(4):
        start = bridge + torch.tensor([4.0 + 0.5 * k, 1.0 - 3.1 * k]) * scale
        start = start + torch.tensor([draw.between(-0.8, 0.8), draw.between(-0.5, 0.5)]) * scale
        length = draw.between(8.5, 12.5) * scale
        along = torch.linspace(0, 1, 8)
        course = torch.stack([along, -0.5 * along - 0.35 * along.square()], 1) * length + start
        course[:, 1] += draw.wave(8, 0.3 * scale)
        yield Stroke("nose", course, draw.between(0.35, 0.65), 1.5 * scale)


def _eye(marks: Tensor, scale: float, draw: _Draw) -> Iterator[Stroke]:
    corner, below = marks[45], marks[46:48].mean(0)
    for k in range(6):
        degrees = 38 - 15.5 * k + draw.between(-4, 4)
        angle = math.radians(degrees)
        start = corner + torch.tensor([6.5 + 1.2 * abs(k - 2), 0.20 * degrees * 0.35]) * scale
        length = draw.between(12, 23) * scale * (1 if k % 2 == 0 else 0.75)
        along = torch.linspace(0, 1, 10)
        bend = draw.between(0.05, 0.2) * (1 if degrees > 0 else -1)
        way = torch.stack([math.cos(angle) * along, math.sin(angle) * along + bend * along.square()], 1)
        course = start + way * length
        course[:, 1] += draw.wave(10, 0.5 * scale)
        yield Stroke(
            "crows_feet", course, draw.between(0.5, 0.9), draw.between(1.5, 2.1) * scale, draw.between(0.05, 0.12)
        )
    for k in range(3):
        half = draw.between(9, 13) * scale
        along = torch.linspace(-1, 1, 10)
        across = below[0] + (2.5 + 1.5 * k) * scale + along * half
        up = below[1] - (5.0 + 2.9 * k + draw.between(-0.4, 0.4)) * scale + (1.6 + 0.4 * k) * scale * along.square()
        course = torch.stack([across, up + draw.wave(10, 0.3 * scale)], 1)
        yield Stroke("lower_lid", course, draw.between(0.25, 0.5), 1.6 * scale, 0.1)


def _nasolabial(marks: Tensor, scale: float, draw: _Draw) -> Iterator[Stroke]:
    wing, mouth = marks[35], marks[54]
    along = torch.linspace(0, 1, 14)[:, None]
    start = wing + torch.tensor([4.5, 6.5]) * scale
    middle = (wing + mouth) / 2 + torch.tensor([9.5, 1.5]) * scale
    end = mouth + torch.tensor([8.0, -6.0 + draw.between(-2, 2)]) * scale
    course = (1 - along).square() * start + 2 * along * (1 - along) * middle + along.square() * end
    course = course + torch.stack([draw.wave(14, 0.5 * scale), torch.zeros(14)], 1)
    yield Stroke("nasolabial", course, draw.between(1.2, 1.5), 4.2 * scale, draw.between(0.16, 0.24), overhang=0.5)
    for k in range(5):
        first, last = draw.between(0.30, 0.55), draw.between(0.8, 1.0)
        piece = course[int(13 * first) : int(13 * last) + 1]
        spread = torch.tensor([5.0 + 4.9 * k + draw.between(-0.9, 0.9), draw.between(-1.5, 2.5)]) * scale
        shifted = piece + spread * torch.linspace(0.85, 1.15, len(piece))[:, None]
        yield Stroke(
            "smile_lines", shifted, draw.between(0.2, 0.75), draw.between(1.9, 2.9) * scale, 0.05, overhang=0.2
        )


def _chin(marks: Tensor, scale: float, draw: _Draw) -> Iterator[Stroke]:
    lip, tip = marks[57], marks[8]
    drop = float(lip[1] - tip[1])
    half = 11.0 * scale
    across = torch.linspace(-half, half, 10)
    up = lip[1] - 0.24 * drop - 2.0 * scale * (across / half).square() + draw.wave(10, 0.3 * scale)
    yield Stroke("mentolabial", torch.stack([across, up], 1), 0.7, 3.2 * scale, 0.12, overhang=0.2)
    for k in range(44):
        # Dimples of a tense mentalis: short curved creases this way and that, on a jittered grid.
        row, column = divmod(k, 11)
        place = torch.tensor([
            (column - 5 + 0.5 * (row % 2) + draw.between(-0.35, 0.35)) * 3.1 * scale,
            float(lip[1]) - (0.36 + 0.15 * row) * drop + draw.between(-1.1, 1.1) * scale,
        ])  # fmt: skip
        angle = draw.between(-0.9, 0.9) + (0.5 * math.pi if k % 2 else 0.0)
        along = torch.linspace(-1, 1, 6)
        length, bow = draw.between(0.9, 1.9) * scale, draw.between(-0.6, 0.6)
        curve = torch.stack([along, bow * (1 - along.square())], 1) * length
        turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        yield Stroke("chin", curve @ turn + place, draw.between(0.25, 0.5), draw.between(1.8, 2.6) * scale, 0.04)


def _lips(marks: Tensor, scale: float, draw: _Draw) -> Iterator[Stroke]:
    upper, lower, base, tip = marks[48:55], marks[[48, 59, 58, 57, 56, 55, 54]], marks[33], marks[8]
    rim_height, skin = float(upper[3, 1]), float(base[1] - upper[3, 1])
    for k in range(13):
        place = (k - 6 + draw.between(-0.25, 0.25)) / 6.0 * 0.88
        rim = _along(upper, place) + torch.tensor([0.0, 1.6 * scale])
        rise = draw.between(0.28, 0.66) * skin
        along = torch.linspace(0, 1, 7)
        course = rim + torch.stack([0.12 * place * rise * along, rise * along], 1)
        course[:, 0] += draw.wave(7, 0.25 * scale) + 0.18 * place * abs(float(rim[1]) - rim_height) * along
        yield Stroke("upper_lip", course, draw.between(0.12, 0.42), 1.6 * scale, 0.05)
    for k in range(9):
        place = (k - 4 + draw.between(-0.25, 0.25)) / 4.0 * 0.8
        rim = _along(lower, place) - torch.tensor([0.0, 2.0 * scale])
        drop = draw.between(0.12, 0.2) * float(lower[3, 1] - tip[1])
        along = torch.linspace(0, 1, 7)
        course = rim + torch.stack([0.2 * place * drop * along + draw.wave(7, 0.25 * scale), -drop * along], 1)
        yield Stroke("lower_lip", course, draw.between(0.2, 0.4), 1.7 * scale, 0.04)


def _along(curve: Tensor, place: float) -> Tensor:
    """A point (2,) of a polyline (K,2) between -1 and 1."""
    position = (place + 1) / 2 * (len(curve) - 1)
    before = min(int(position), len(curve) - 2)
    return torch.lerp(curve[before], curve[before + 1], position - before)
