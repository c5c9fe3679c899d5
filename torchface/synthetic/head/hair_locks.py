"""Locks of a haircut: strips that start on the scalp of the sculpture and follow its form along a style's way."""

from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_normals
from torchface.mesh import fan_triangulation
from torchface.synthetic.head.hair import GrownPart, hair_share
from torchface.synthetic.head.identity import ramp, sculpted_vertices
from torchface.synthetic.head.signed_distance import gradient, signed_distance
from torchface.synthetic.head.skin_texture import noise
from torchface.synthetic.head.teeth_and_tongue import HeadPart
from torchface.synthetic.head.topology import topology

Style = Literal["short", "long", "tied"]

LOCK_PATCH = (0.577, 0.785, 0.612, 0.985)
"""Place on the page that locks are coloured from: across them, and from root to tip."""
KNOT = (0.0, 46.0, -104.0)  # where tied hair is held together
_KNOT_RADIUS = 21.0
_FRINGE = 38.0  # how high a fringe ends, millimetres
_PARTING = {"short": 24.0, "long": 7.0, "tied": 0.0, "fringe": 12.0}
_ROWS = {"short": 7, "long": 12, "tied": 9, "fringe": 8}
_SPACING = {"short": 7.0, "long": 9.0, "tied": 9.0, "fringe": 5.0}
_LOOSE = {"short": 0.07, "long": 0.035, "tied": 0.04, "fringe": 0.05}
_EAR = ((76.0, -12.0, -13.0), (11.0, 36.0, 25.0))  # centre and radii of what hair passes over


@lru_cache(maxsize=6)
def hair_locks(style: Style, fringe: bool = False) -> GrownPart:
    """All locks of a haircut, with a fringe down to the brows if asked for."""
    whole = _grown(style, *_roots(style))
    if not fringe:
        return whole
    front = _grown("fringe", *_roots("fringe"))
    return GrownPart(
        HeadPart.joined([whole.part, front.part]),
        torch.cat([whole.hosts, front.hosts]),
        torch.cat([whole.weights, front.weights]),
    )


def _grown(style: str, roots: Tensor, normals: Tensor, hosts: Tensor, weights: Tensor) -> GrownPart:
    random = np.random.default_rng(9)
    rows, count = _ROWS[style], len(roots)
    jitter = torch.from_numpy(random.normal(0, 1, (count, 3)))
    step = _length(style, roots) * (1 + 0.12 * jitter[:, 0].clamp(-2, 2)) / (rows - 1)
    height = _heights(style, roots, rows) * (1 + 0.14 * jitter[:, 1:2].clamp(-1.5, 1.5))
    points = [roots - 0.8 * normals]
    sides, ups = [], []
    for row in range(rows):  # each piece of a lock starts where the one before ends
        here = points[-1]
        up = _outward(here)
        way = _way(style, here, up, roots, row / (rows - 1)) + _LOOSE[style] * jitter
        flat = way - (way * up).sum(1, keepdim=True) * up * _hugging(style, here)
        way = torch.nn.functional.normalize(flat, dim=1)
        sides.append(torch.nn.functional.normalize(torch.linalg.cross(way, up), dim=1))
        ups.append(up)
        if row + 1 < rows:
            # Short at first, where the head curves, and no farther than the shoulders or the knot.
            stride = step * (0.35 + 1.3 * row / (rows - 2))
            if style == "long":
                stride = stride * (0.04 + 0.96 * ramp(here[:, 1], -170, -140))
            elif style == "tied":
                stride = stride.minimum(0.7 * (torch.tensor(KNOT).double() - here).norm(dim=1))
            points.append(_held(style, here + stride[:, None] * way, height[:, row + 1]))
    line = torch.stack(points, 1)
    for _ in range(3):  # evens out where they were pushed
        line[:, 2:-1] = 0.5 * line[:, 2:-1] + 0.25 * (line[:, 1:-2] + line[:, 3:])
    line[:, 1:] = _held(style, line[:, 1:].reshape(-1, 3), height[:, 1:].reshape(-1)).view(count, rows - 1, 3)
    width = _widths(style, roots, rows) * (1 + 0.2 * jitter[:, 2:].clamp(-1.5, 1.5))
    part = _strips(line, torch.stack(sides, 1), (1.0 if style == "short" else 0.5) * torch.stack(ups, 1), width)
    hosts, weights = hosts.repeat_interleave(3 * rows, 0), weights.repeat_interleave(3 * rows, 0)
    if style == "tied":
        knot = _knot()
        top = torch.cdist(torch.tensor([KNOT]).double(), sculpted_vertices()).argmin()
        extra = len(knot.vertices)
        part = HeadPart.joined([part, knot])
        hosts = torch.cat([hosts, top.expand(extra, 3)])
        weights = torch.cat([weights, torch.tensor([[1.0, 0.0, 0.0]]).double().expand(extra, 3)])
    return GrownPart(part, hosts, weights)


def _roots(style: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Places on the scalp about evenly far from each other: points, normals, hosts and weights."""
    t, v = topology(), sculpted_vertices()
    faces = fan_triangulation(t.quads)
    bare = torch.zeros(t.count, dtype=torch.bool)
    for part in (t.rings["ear"], t.caps["ear"], t.rings["eye"][1:]):
        bare[part.flatten()] = bare[t.mirror[part.flatten()]] = True
    share = hair_share(v)
    faces = faces[(share[faces] > 0.02).any(1) & ~bare[faces].any(1)]
    corners = v[faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1) / 2
    random = np.random.default_rng(4)
    drawn = torch.from_numpy(random.choice(len(faces), 9000, p=(area / area.sum()).numpy()))
    weights = torch.from_numpy(random.dirichlet((1, 1, 1), 9000))
    points = (corners[drawn] * weights[..., None]).sum(1)
    share = hair_share(points)
    # Closer along the hairline, where single locks are seen.
    radius = (_SPACING[style] * (0.62 + 0.38 * ramp(share, 0.05, 0.6))).numpy()
    tree, alive = cKDTree(points.numpy()), (share > 0.03).numpy()
    if style == "fringe":
        alive &= ((points[:, 2] > 30) & (points[:, 0].abs() < 48) & (share > 0.15)).numpy()
    elif style == "short":  # sides and back are cropped: the cap shows them, locks break its edge
        alive &= ((_top(points) > 0.1) | ((share < 0.3) & (points[:, 1] > 42))).numpy()
    kept = []
    for i in range(len(points)):  # one by one: each that is kept keeps others away
        if alive[i]:
            kept.append(i)
            alive[tree.query_ball_point(points[i].numpy(), radius[i])] = False
    at = torch.tensor(kept)
    hosts, weights = faces[drawn[at]], weights[at]
    normals = (vertex_normals(v, fan_triangulation(t.quads))[hosts] * weights[..., None]).sum(1)
    return points[at], torch.nn.functional.normalize(normals, dim=1), hosts, weights


def _outward(points: Tensor) -> Tensor:
    """Away from the head, (N,3)."""
    return gradient(points, 0.5)


def _top(roots: Tensor) -> Tensor:
    """Where hair is left long in a short haircut, (N,) in [0,1]."""
    return ramp(roots[:, 1] + 26 * ramp(roots[:, 2], 20, 56) - 0.35 * (roots[:, 0].abs() - 34).clamp(min=0), 58, 80)


def _to_parting(style: str, points: Tensor) -> Tensor:
    """To which side of the parting points lie, about -1 or 1, (N,)."""
    return torch.tanh((points[:, 0] - _PARTING[style]) / 2.0)


def _way(style: str, points: Tensor, up: Tensor, roots: Tensor, along: float) -> Tensor:
    """Where hair goes on from points (N,3), (N,3)."""
    y, z = points[:, 1], points[:, 2]
    side = _to_parting(style, roots)
    one = torch.ones_like(y)
    if style == "tied":
        return torch.nn.functional.normalize(torch.tensor(KNOT).double() - points, dim=1)
    if style == "fringe":
        return torch.stack([0.12 * side + roots[:, 0] / 160, -one, 0.9 * ramp(y, 50, 80)], 1)
    if style == "long":
        front = ramp(z, 2, 34)
        over = torch.stack([side, 0.1 * one, -0.35 - 1.3 * front], 1)
        inward = -0.16 * torch.tanh(points[:, 0] / 20) * (1 - ramp(y, -50, -5))
        down = torch.stack([inward, -one, 0.02 * one], 1)
        wave = 0.10 * torch.sin(torch.stack([y / 17 + roots[:, 2] / 9, 0 * y, y / 21 + roots[:, 0] / 7], 1))
        falls = (1 - ramp(up[:, 1], 0.15, 0.75)) * (1 - 0.75 * front)
        return over * (1 - falls)[:, None] + (down + wave) * falls[:, None]
    top = _top(roots)[:, None]
    front = ramp(roots[:, 2], 20, 62)
    sweep = torch.stack([(1.0 - 0.45 * front) * side, 0.5 * (1 - along) * front, -0.30 - 0.7 * front], 1)
    down = torch.stack([0.05 * side, -0.9 * one, -0.25 - 0.45 * ramp(-z, -10, 40)], 1)
    return sweep * top + down * (1 - top)


def _hugging(style: str, points: Tensor) -> Tensor:
    """How far hair keeps to the head's form, (N,1): long hair hangs where the head recedes."""
    if style != "long":
        return torch.ones(len(points), 1, dtype=points.dtype)
    return ramp(points[:, 1], -10, 50)[:, None]


def _held(style: str, points: Tensor, height: Tensor) -> Tensor:
    """Points moved to their height over the head; long hair that hangs is kept out of it alone."""
    off = height - signed_distance(points)
    if style == "long":
        off = torch.where(points[:, 1] > 25, off, off.clamp(min=0))
    points = points + off[:, None] * _outward(points)
    if style == "long":
        centre, radii = (torch.tensor(part).double() for part in _EAR)
        mirror = torch.stack([points[:, 0].sign(), torch.ones(len(points)), torch.ones(len(points))], 1)
        reach = (points * mirror - centre) / radii
        push = reach / reach.norm(dim=1, keepdim=True).clamp(min=0.3) * radii * mirror
        inside = reach.norm(dim=1, keepdim=True) < 1
        points = torch.where(inside, centre * mirror + push, points)
    return points


def _length(style: str, roots: Tensor) -> Tensor:
    """Millimetres of each lock."""
    y, z = roots[:, 1], roots[:, 2]
    if style == "tied":
        return 1.12 * (torch.tensor(KNOT).double() - roots).norm(dim=1) + 4
    if style == "fringe":
        return (y - _FRINGE).clamp(min=10) * 1.25
    if style == "long":
        return (y + 170).clamp(min=60) * 1.02 + 55 * ramp(y, 40, 95)
    return 12 + 50 * _top(roots) * (1 + 0.15 * ramp(z, 20, 60))


def _heights(style: str, roots: Tensor, rows: int) -> Tensor:
    """Millimetres over the head along each lock, (N,rows)."""
    z, share = roots[:, 2], ramp(hair_share(roots), 0.0, 0.7)
    along = torch.linspace(0, 1, rows, dtype=torch.float64)
    swell = torch.sin(np.pi * along.clamp(0, 1) ** 0.7)
    if style == "tied":
        return (3.2 + 2.6 * share)[:, None] * (0.6 + 0.4 * swell) + 2.0 * along
    if style == "fringe":
        return (2.5 + 6.0 * share)[:, None] * (0.4 + 0.6 * swell) + 2.0
    if style == "long":
        return 2.0 + (4.0 + 11.0 * share)[:, None] * (0.3 + 0.7 * along.clamp(max=0.25) / 0.25)
    full = 1.6 + 1.0 * share + _top(roots) * (8.0 + 6.5 * ramp(z, 15, 62)) * (0.45 + 0.55 * share)
    return full[:, None] * (0.2 + 0.8 * swell) + 0.4


def _widths(style: str, roots: Tensor, rows: int) -> Tensor:
    """Millimetres across each lock, (N,rows), to a point."""
    along = torch.linspace(0, 1, rows, dtype=torch.float64)
    taper = (1 - along ** (2.0 if style == "short" else 5.0)) * (0.55 + 0.45 * (along / 0.3).clamp(max=1))
    share = ramp(hair_share(roots), 0.02, 0.45)
    wide = {"short": 2.6 + 8.0 * _top(roots), "long": torch.full_like(share, 13.0),
            "tied": torch.full_like(share, 10.0), "fringe": torch.full_like(share, 9.0)}[style]  # fmt: skip
    return (wide * (0.45 + 0.55 * share))[:, None] * taper.clamp(min=0.03)


def _strips(line: Tensor, sides: Tensor, ups: Tensor, width: Tensor) -> HeadPart:
    """Strips three vertices wide and raised in the middle, along lines (N,R,3) with sides and ups alike."""
    count, rows = line.shape[:2]
    half = 0.5 * width[..., None] * sides
    points = torch.stack([line - half, line + 0.20 * width[..., None] * ups, line + half], 2)
    ids = torch.arange(count * rows * 3).view(count, rows, 3)
    quads = torch.stack([ids[:, :-1, :-1], ids[:, :-1, 1:], ids[:, 1:, 1:], ids[:, 1:, :-1]], -1)
    left, low, right, high = LOCK_PATCH
    start = torch.frac(torch.arange(count) * 0.618)[:, None, None] * 0.55
    u = left + (right - left) * (start + 0.45 * torch.tensor([0.0, 0.5, 1.0])).expand(count, rows, 3)
    v = (high + (low - high) * torch.linspace(0, 1, rows))[None, :, None].expand(count, rows, 3)
    place = torch.stack([u, v], -1)
    around = torch.stack([place[:, :-1, :-1], place[:, :-1, 1:], place[:, 1:, 1:], place[:, 1:, :-1]], 3)
    return HeadPart(points.reshape(-1, 3), quads.reshape(-1, 4), around.reshape(-1, 4, 2))


def _knot() -> HeadPart:
    """A bun: locks wound about an axis that points away from the head."""
    turns, rows = 18, 22
    centre = torch.tensor(KNOT).double()
    axis = torch.nn.functional.normalize(torch.tensor([0.0, 0.25, -1.0]).double(), dim=0)
    right = torch.tensor([1.0, 0.0, 0.0]).double()
    upward = torch.linalg.cross(axis, right)
    start = torch.arange(turns).double()[:, None] * 2.39996
    angle = start + torch.linspace(0, 6.8, rows, dtype=torch.float64)
    polar = 0.25 + 1.35 * torch.frac(torch.arange(turns).double() * 0.618)[:, None] + 0.25 * torch.sin(2 * angle)
    out = polar.cos()[..., None] * axis + polar.sin()[..., None] * (
        angle.cos()[..., None] * right + angle.sin()[..., None] * upward
    )
    radius = _KNOT_RADIUS * (1 + 0.05 * torch.sin(start))
    line = centre + out * radius[..., None]
    way = torch.gradient(line, dim=1)[0]
    sides = torch.nn.functional.normalize(torch.linalg.cross(way, out), dim=-1)
    width = torch.full((turns, rows), 13.0, dtype=torch.float64) * torch.linspace(-1, 1, rows).abs().pow(4).neg().add(
        1
    ).clamp(min=0.1)
    return _strips(line, sides, out, width)


def strand_shade(across: Tensor, along: Tensor) -> Tensor:
    """Light and dark of strands on the locks' patch, at shares (M,) across it and along from the root, about 1."""
    at = torch.stack([across * 90, along * 5, 0 * along], 1)
    fine = 0.55 * noise(at, 1.0, 61) + 0.35 * noise(at * torch.tensor([0.35, 1.0, 1.0]), 1.0, 62)
    return (0.74 + 0.45 * ramp(along, 0.0, 0.55)) * (1 + 0.5 * fine)
