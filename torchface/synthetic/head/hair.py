"""Hair of the sculpture: a cap over the scalp, and single hairs of brows and lashes with the skin that they grow on."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_normals
from torchface.mesh import fan_triangulation
from torchface.rendering.raycast import RayCaster
from torchface.synthetic.head.facial_openings import lid_order
from torchface.synthetic.head.identity import ramp, sculpted_vertices
from torchface.synthetic.head.signed_distance import EYE_CENTRE
from torchface.synthetic.head.skin_texture import brow_line, noise
from torchface.synthetic.head.teeth_and_tongue import HeadPart
from torchface.synthetic.head.topology import EYE_RIM, topology
from torchface.synthetic.head.uv_layout import unwrapping

WHORL = (8.0, 88.0, -52.0)  # where the hair of the head starts from
HAIR_PATCH = (0.62, 0.955, 0.70, 0.985)  # place on the page that brows and lashes are coloured from
_BROW_HAIRS, _LASHES = 260, 3


@dataclass(frozen=True, eq=False)
class GrownPart:
    """A part that skin carries: its own form, and for each vertex (V,) three skin vertices (V,3) with weights (V,3)."""

    part: HeadPart  # its form on the sculpture
    # hosts, weights: of the skin at each vertex's root
    hosts: Tensor
    weights: Tensor
    turns: bool = False  # whether it turns with the skin about the nearer eye, as lashes do


def hair_share(points: Tensor) -> Tensor:
    """How thick hair stands over points (N,3) of the sculpture, 0 on bare skin, 1 well inside the hairline."""
    x, y, z = points[:, 0].abs(), points[:, 1], points[:, 2]
    line = np.interp(
        z.numpy(),
        [-200, -84, -60, -38, -24, -14, 0, 12, 20, 26, 32, 40, 56, 66, 74, 90],
        [-72, -70, -58, -34, 4, 18, 10, -2, 2, 16, 30, 42, 54, 58, 60, 62],
    )
    edge = torch.from_numpy(line).to(y) + 0.05 * (x - 40).clamp(min=0)
    wave = 2.5 * noise(points.float(), 16.0, 21).to(y) + 3.0 * noise(points.float(), 4.0, 22).to(y)
    return ramp(y - edge + wave, -2.0, 26.0)


def flow(points: Tensor) -> Tensor:
    """Across and along the hair from the whorl, millimetres, (N,2)."""
    offset = points - torch.tensor(WHORL).to(points)
    out = offset.norm(dim=1)
    bearing = torch.atan2(offset[:, 0], offset[:, 2])
    return torch.stack([bearing * 55.0 + 0.10 * out, out], 1)


@lru_cache(maxsize=2)
def scalp_hair(thick: float) -> GrownPart:
    """The cap under the locks: the scalp's quads, and their place on the page, raised by a share of cropped hair."""
    t, flat, v = topology(), unwrapping(), sculpted_vertices()
    normals = vertex_normals(v, fan_triangulation(t.quads))
    bare = torch.zeros(t.count, dtype=torch.bool)
    for part in (t.rings["ear"][1:], t.caps["ear"], t.rings["eye"][1:]):
        bare[part.flatten()] = bare[t.mirror[part.flatten()]] = True
    share = hair_share(v)
    keep = (share[t.quads] > 0).any(1) & ~bare[t.quads].any(1)
    quads, uv_quads = t.quads[keep], flat.quads[keep]
    ids, index = quads.unique(return_inverse=True)
    points, ways = v[ids], torch.nn.functional.normalize(normals[ids], dim=1)
    amount = hair_share(points)
    height = thick * amount * _height(points) - 0.7 * (1 - amount) ** 6
    cap = HeadPart(points + height[:, None] * ways, index, flat.uvs[uv_quads].float())
    return GrownPart(cap, ids[:, None].expand(-1, 3), torch.full((len(ids), 3), 1 / 3, dtype=torch.float64))


def _height(points: Tensor) -> Tensor:
    """Millimetres that hair stands over the scalp: short at the sides, longer on top, most over the forehead."""
    y, z = points[:, 1], points[:, 2]
    top = ramp(y, 45, 95)
    return 3.2 + 5.5 * top + 4.0 * top * ramp(z, -10, 60) + 1.5 * ramp(y, 20, 60)


@lru_cache(maxsize=1)
def brow_hairs() -> GrownPart:
    """Hairs of both brows: upright at the nose, lying outward farther along."""
    random = np.random.default_rng(5)
    along = random.beta(1.0, 1.05, _BROW_HAIRS)
    x = torch.from_numpy(9.0 + 41.0 * along)
    middle, half = (part.double() for part in brow_line(x.float()))
    across = torch.from_numpy(random.uniform(-1, 1, _BROW_HAIRS))
    y = middle + across * half * 0.85
    lean = torch.from_numpy(np.interp(along, [0, 0.15, 0.5, 1], [1.25, 0.85, 0.40, -0.25])) - 0.35 * across
    lean = lean + torch.from_numpy(random.normal(0, 0.12, _BROW_HAIRS))
    starts = torch.stack([x, y, torch.full_like(x, 140.0)], 1)
    caster = _skin_caster()
    hits = caster.cast(starts, torch.tensor([0.0, 0.0, -1.0]).double().expand_as(starts))
    faces, v = fan_triangulation(topology().quads), sculpted_vertices()
    hosts, weights = faces[hits.triangle], hits.barycentric.double()
    roots = (v[hosts] * weights[..., None]).sum(1)
    normals = torch.nn.functional.normalize((vertex_normals(v, faces)[hosts] * weights[..., None]).sum(1), dim=1)
    way = torch.stack([lean.cos(), lean.sin(), torch.zeros_like(x)], 1)
    way = torch.nn.functional.normalize(way - (way * normals).sum(1, keepdim=True) * normals, dim=1)
    length = torch.from_numpy(random.uniform(5.5, 9.0, _BROW_HAIRS) * np.interp(along, [0, 0.2, 1], [0.8, 1, 0.75]))
    lift = normals * 0.9
    return _both_sides(_hairs(roots - 0.2 * normals, way * length[:, None], lift, 0.27), hosts, weights, False)


@lru_cache(maxsize=1)
def lashes() -> GrownPart:
    """Lashes of all four lids, curved away from the eye."""
    v, rim = sculpted_vertices(), topology().rings["eye"][EYE_RIM]
    random = np.random.default_rng(6)
    made, hosts, weights = [], [], []
    for lid, up, long in ((lid_order()[0], 1.0, 6.0), (lid_order()[1], -1.0, 2.6)):
        count = _LASHES * 14 if up > 0 else 2 * 13
        place = torch.linspace(1.6, 15.4, count, dtype=torch.float64) + torch.from_numpy(random.normal(0, 0.08, count))
        low = place.floor().long()
        part = place - low
        ends = torch.stack([rim[lid[low]], rim[lid[low + 1]], rim[lid[low]]], 1)
        share = torch.stack([1 - part, part, 0 * part], 1)
        roots = (v[ends] * share[..., None]).sum(1)
        out = torch.nn.functional.normalize(roots - torch.tensor(EYE_CENTRE).double(), dim=1)
        fan = (place - 7.0) / 9.0
        way = out + torch.stack([0.55 * fan, torch.full_like(fan, 0.15 * up), 0.1 + 0 * fan], 1)
        length = long * (
            0.72 + 0.28 * torch.from_numpy(np.interp(place.numpy(), [1, 5, 11, 14, 16], [0, 0.7, 1, 1, 0.6]))
        )
        length = length * torch.from_numpy(random.uniform(0.8, 1.1, count))
        curl = torch.tensor([0.0, up, 0.0]).double() * 0.34 * length[:, None]
        made.append(
            _hairs(
                roots,
                torch.nn.functional.normalize(way, dim=1) * length[:, None],
                curl,
                0.42 if up > 0 else 0.28,
                curved=True,
            )
        )
        hosts.append(ends)
        weights.append(share)
    return _both_sides(HeadPart.joined(made), torch.cat(hosts), torch.cat(weights), True)


def _hairs(roots: Tensor, ways: Tensor, bend: Tensor, width: float, curved: bool = False) -> HeadPart:
    """Tapering blades of two quads from roots (N,3) along ways (N,3), bent by (N,3) at the middle, or the tip."""
    side = torch.linalg.cross(ways, bend)
    side = torch.nn.functional.normalize(side, dim=1) * width / 2
    middle = roots + 0.5 * ways + (0.12 if curved else 1.0) * bend
    tip = roots + ways + (1.0 if curved else 0.35) * bend
    rows = [roots - side, roots + side, middle - 0.8 * side, middle + 0.8 * side, tip - 0.12 * side, tip + 0.12 * side]
    points = torch.stack(rows, 1)
    quads = torch.tensor([[0, 1, 3, 2], [2, 3, 5, 4]])
    left, low, right, high = HAIR_PATCH
    tone = torch.frac(torch.arange(len(roots)) * 0.618)[:, None, None, None]
    step = torch.tensor([[0.0, 0.0, 0.5, 0.5], [0.5, 0.5, 1.0, 1.0]])
    u = (left + tone * (right - left)).expand(-1, 2, 4, 1)
    uvs = torch.cat([u, (low + step * (high - low))[None, ..., None].expand(len(roots), -1, -1, 1)], -1)
    starts = torch.arange(len(roots))[:, None, None] * 6
    return HeadPart(points.reshape(-1, 3), (starts + quads).reshape(-1, 4), uvs.reshape(-1, 4, 2))


def _both_sides(part: HeadPart, hosts: Tensor, weights: Tensor, turns: bool) -> GrownPart:
    hosts, weights = hosts.repeat_interleave(6, 0), weights.repeat_interleave(6, 0)
    both = HeadPart.joined([part, part.mirrored()])
    return GrownPart(both, torch.cat([hosts, topology().mirror[hosts]]), weights.repeat(2, 1), turns)


@lru_cache(maxsize=1)
def _skin_caster() -> RayCaster:
    return RayCaster(sculpted_vertices(), fan_triangulation(topology().quads))
