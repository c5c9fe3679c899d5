"""Teeth, gums and tongue of the sculpture, with their places on the texture's page."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

# Crowns of one side from the middle to the second molar, millimetres: width, height, depth, thickness of the edge,
# how far the edge lies short of the incisors', height of the cusp.
_UPPER = (
    (8.6, 10.6, 7.0, 1.6, 0.0, 0.0), (6.8, 9.2, 6.4, 1.5, 0.7, 0.0), (7.6, 10.2, 8.0, 2.2, 0.0, 1.3),
    (7.0, 8.4, 9.0, 5.0, 0.9, 0.9), (6.8, 7.8, 9.0, 5.2, 1.1, 0.6), (10.0, 7.4, 11.0, 7.6, 1.2, 0.3),
    (9.4, 7.0, 11.0, 7.6, 1.5, 0.3),
)  # fmt: skip
_LOWER = (
    (5.5, 8.8, 6.0, 1.4, 0.2, 0.0), (6.0, 9.0, 6.2, 1.4, 0.2, 0.0), (6.9, 9.8, 7.6, 2.0, 0.0, 1.2),
    (7.1, 8.4, 7.8, 4.4, 0.5, 0.9), (7.2, 8.0, 8.2, 5.0, 0.6, 0.6), (11.0, 7.4, 10.2, 7.4, 0.6, 0.3),
    (10.4, 7.0, 10.0, 7.4, 0.8, 0.3),
)  # fmt: skip
_EDGES = {"upper": (-69.4, 84.4, -1.0), "lower": (-67.6, 81.6, 1.0)}
"""Height of the incisors' edge, depth of their front on the midline, the way from the gum to the edge."""

_ROUND, _GUM_STEPS = 10, 4
_LEVELS = np.array([-0.3, 0.02, 0.35, 0.7, 0.92, 1.0])
_WIDTHS = np.array([0.70, 0.78, 0.93, 1.0, 0.97, 0.86])
PAGE = {"teeth": (0.252, 0.80, 0.312, 0.93), "gums": (0.325, 0.80, 0.385, 0.93), "tongue": (0.62, 0.80, 0.74, 0.93)}
"""Left, lower, right and upper border of each part on the page, among the islands above the skin; teeth stand side by
side in theirs, the incisors left."""

TEETH = len(_UPPER)

_RISE, _SPREAD = 9.5e-4, 3.2  # of the dental arch: how far it falls back at a distance from the midline


@dataclass(frozen=True, eq=False)
class HeadPart:
    """A part of its own: vertices (V,3), quads (Q,4), page coordinates of the quads' corners (Q,4,2)."""

    vertices: Tensor
    quads: Tensor
    uvs: Tensor

    @staticmethod
    def grid(points: Tensor, page: tuple[float, float, float, float], closed: bool = False) -> HeadPart:
        """A sheet of points (R,C,3), whose columns close to a tube if ``closed``, on a rectangle of the page."""
        rows, columns = points.shape[:2]
        ids = torch.arange(rows * columns).view(rows, columns)
        ids = torch.cat([ids, ids[:, :1]], 1) if closed else ids
        v, u = torch.meshgrid(torch.linspace(0, 1, rows), torch.linspace(0, 1, ids.shape[1]), indexing="ij")
        place = torch.stack([page[0] + u * (page[2] - page[0]), page[1] + v * (page[3] - page[1])], -1)
        around = lambda t: torch.stack([t[:-1, :-1], t[:-1, 1:], t[1:, 1:], t[1:, :-1]], 2)  # noqa: E731
        return HeadPart(points.reshape(-1, 3), around(ids).reshape(-1, 4), around(place).reshape(-1, 4, 2))

    @staticmethod
    def joined(parts: list[HeadPart]) -> HeadPart:
        """Several parts as one."""
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        return HeadPart(
            torch.cat([part.vertices for part in parts]),
            torch.cat([part.quads + int(start) for part, start in zip(parts, starts, strict=False)]),
            torch.cat([part.uvs for part in parts]),
        )

    def turned(self) -> HeadPart:
        """The same with its outside inside."""
        return HeadPart(self.vertices, self.quads.flip(1), self.uvs.flip(1))

    def mirrored(self) -> HeadPart:
        """Its image on the other side of the face."""
        flipped = self.vertices * torch.tensor([-1.0, 1.0, 1.0], dtype=self.vertices.dtype)
        return HeadPart(flipped, self.quads, self.uvs).turned()


@lru_cache(maxsize=1)
def mouth_parts() -> dict[str, HeadPart]:
    """Teeth and gums of both jaws and the tongue at rest, float64."""
    parts = {}
    for jaw, crowns in (("upper", _UPPER), ("lower", _LOWER)):
        parts[f"teeth_{jaw}"], parts[f"gums_{jaw}"] = _jaw(jaw, np.array(crowns))
    parts["tongue"] = _tongue(_TONGUE_AT_REST)
    return parts


@lru_cache(maxsize=1)
def tongue_out() -> Tensor:
    """The tongue's vertices put out over the lower lip of a jaw that is a third open, (V,3)."""
    return _tongue(_TONGUE_OUT).vertices


def _arch(arc: np.ndarray, front: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (N,2) of the arch, x and z, at lengths along it from the midline, and the outward normals (N,2)."""
    x = np.linspace(0, 33, 800)
    z = front - _RISE * x**_SPREAD
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
    across = np.interp(np.abs(arc), length, x)
    slope = _RISE * _SPREAD * across ** (_SPREAD - 1)
    normal = np.stack([np.sign(arc) * slope, np.ones_like(slope)], 1)
    points = np.stack([np.sign(arc) * across, front - _RISE * across**_SPREAD], 1)
    return points, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _jaw(jaw: str, crowns: np.ndarray) -> tuple[HeadPart, HeadPart]:
    edge, front, way = _EDGES[jaw]
    borders = np.concatenate([[0], np.cumsum(crowns[:, 0])])
    teeth = []
    left, low, right, high = PAGE["teeth"]
    for number, (crown, start) in enumerate(zip(crowns, borders, strict=False)):  # fourteen, each of its own form
        strip = (left + number / TEETH * (right - left), low, left + (number + 1) / TEETH * (right - left), high)
        tooth = _tooth(crown, start + crown[0] / 2, front, edge, way, strip)
        tooth = tooth.turned() if way > 0 else tooth
        teeth += [tooth, tooth.mirrored()]
    return HeadPart.joined(teeth), _gums(crowns, borders, front, edge, way)


def _tooth(
    crown: np.ndarray, arc: float, front: float, edge: float, way: float, page: tuple[float, float, float, float]
) -> HeadPart:
    """Loops round a crown from under the gum to its edge, and a lid of quads, on a rectangle of the page."""
    width, height, depth, thin, short, cusp = crown
    angle = (np.arange(_ROUND) + 0.5) * 2 * np.pi / _ROUND
    round_off = lambda t: np.sign(t) * np.abs(t) ** 0.72  # noqa: E731
    across, labial = round_off(np.cos(angle)), round_off(np.sin(angle))
    profile = np.array([0.92, 1.0, 0.88, 0.0, 0.0, 0.0])
    deep = np.where(profile > 0, profile * depth, [0, 0, 0, thin + 0.35 * (depth - thin), thin * 1.15, thin * 0.7])
    bulge = np.array([-0.8, 0.0, 0.45, 0.15, -0.25, -0.55])
    place, normal = _arch(np.array([arc]), front)
    along = np.array([normal[0, 1], -normal[0, 0]])
    out = bulge[:, None] - deep[:, None] / 2 + deep[:, None] / 2 * labial
    side = 0.5 * 0.975 * width * _WIDTHS[:, None] * across
    flat = place[0] + out[..., None] * normal[0] + side[..., None] * along
    level = np.repeat(_LEVELS[:, None] * height, _ROUND, 1)
    level[-2:] -= np.array([[0.5], [1.0]]) * cusp * np.abs(across)
    y = edge - way * (height + short) + way * level
    tube = HeadPart.grid(torch.from_numpy(np.stack([flat[..., 0], y, flat[..., 1]], -1)), page, closed=True)
    last, i = (len(_LEVELS) - 1) * _ROUND, torch.arange(_ROUND // 2 - 1)
    lid = torch.stack([last + i, last + i + 1, last + _ROUND - 2 - i, last + _ROUND - 1 - i], 1)
    left, _, right, top = page
    spots = torch.tensor([[left, top - 0.01], [right, top - 0.01], [right, top], [left, top]])
    return HeadPart(tube.vertices, torch.cat([tube.quads, lid]), torch.cat([tube.uvs, spots.expand(len(lid), 4, 2)]))


def _gums(crowns: np.ndarray, borders: np.ndarray, front: float, edge: float, way: float) -> HeadPart:
    """A sheet along the arch: from the lip over the gum's scalloped edge, behind the teeth, to the midline."""
    steps = np.concatenate([np.linspace(a, b, _GUM_STEPS, endpoint=False) for a, b in pairwise(borders)])
    arc = np.append(steps, borders[-1])
    arc = np.concatenate([-arc[:0:-1], arc])
    middle = (borders[1:] + borders[:-1]) / 2
    of = lambda column: np.interp(np.abs(arc), middle, crowns[:, column])  # noqa: E731
    phase = np.concatenate([np.tile(np.arange(_GUM_STEPS), len(crowns)), [0]]) / _GUM_STEPS
    phase = np.concatenate([phase[:0:-1], phase])
    papilla = np.abs(np.cos(np.pi * phase)) ** 3
    line = edge - way * (of(1) + of(4) - 0.6) + way * 2.6 * papilla  # the gum reaches farther between two teeth
    depth = of(2)
    points, normal = _arch(arc, front)
    rows = []
    for out, up in ((-1.0, 11.0), (0.4, 6.5), (0.8, 2.2), (0.6, 0.0), (-1.4, 0.4)):
        rows.append((points + (out - 0.5 * papilla)[:, None] * normal, line - way * up))
    for out, up in ((1.4, 0.4), (-0.6, 0.0), (-2.0, 3.2)):
        rows.append((points - (depth - out)[:, None] * normal, line - way * up))
    vault = (line - way * 3.2) - way * (7.0 if way < 0 else 5.0)
    inner = rows[-1][0]
    rows.append((inner * np.array([0.6, 0.97]), vault))
    rows.append((inner * np.array([0.0, 0.95]), vault - way * 1.5))
    sheet = np.stack([np.stack([p[:, 0], y, p[:, 1]], -1) for p, y in rows], 1)
    part = HeadPart.grid(torch.from_numpy(sheet), PAGE["gums"])
    return part.turned() if way > 0 else part


# Stations from the root to the tip: share of the length, depth, height, half the width, half the thickness.
_TONGUE_AT_REST = np.array([
    (0.0, 24, -84.0, 15, 7.0), (0.25, 36, -76.0, 18.5, 8.5), (0.5, 50, -73.0, 19, 7.5), (0.75, 63, -73.0, 16.5, 5.2),
    (0.92, 70, -74.0, 11.5, 3.4), (1.0, 73, -74.6, 7.5, 2.0),
])  # fmt: skip
_TONGUE_OUT = np.array([
    (0.0, 24, -84.0, 15, 7.0), (0.25, 46, -76.5, 18, 7.0), (0.5, 70, -72.3, 14.0, 2.6), (0.64, 84, -71.8, 13.5, 2.2),
    (0.78, 96, -74.5, 13.5, 2.9), (0.92, 106, -83.0, 11.5, 2.7), (1.0, 110, -89.5, 7.5, 1.7),
])  # fmt: skip
_TONGUE_STATIONS, _TONGUE_ROUND = 20, 20
_TONGUE_TIP, _TONGUE_CAP = 4.5, 4  # length in millimetres, rows


def _tongue(stations: np.ndarray) -> HeadPart:
    """A tube flattened to a tongue with a furrow, closed at its tip."""
    share = np.sin(np.linspace(0, np.pi / 2, _TONGUE_STATIONS))
    z, y, wide, thick = PchipInterpolator(stations[:, 0], stations[:, 1:])(share).T
    ahead = np.stack([np.gradient(y), np.gradient(z)], 1)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    angle = 2 * np.pi * (np.arange(_TONGUE_ROUND) + 0.5) / _TONGUE_ROUND
    across, up = np.cos(angle), np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 0.8
    furrow = np.exp(-((across * wide[:, None] / 2.6) ** 2)) * (up > 0) * np.minimum(thick / 4, 1)[:, None]
    rise = thick[:, None] * up - 1.3 * furrow
    points = np.stack([
        wide[:, None] * across, y[:, None] + rise * ahead[:, 1:], z[:, None] - rise * ahead[:, :1],
    ], -1)  # fmt: skip
    turn = np.linspace(0, np.pi / 2, _TONGUE_CAP + 1)[1:, None, None]
    middle = points[-1].mean(0)
    cap = middle + np.maximum(np.cos(turn), 0.02) * (points[-1] - middle)
    points = np.concatenate([points, cap + _TONGUE_TIP * np.sin(turn) * np.array([0, *ahead[-1]])])
    return HeadPart.grid(torch.from_numpy(points), PAGE["tongue"], closed=True)
