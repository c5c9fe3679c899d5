"""Depth seen from several sides fused into one surface, as a hand-held scanner does it."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.geometry.meshes.operators import triangle_normals
from torchface.mesh import Mesh
from torchface.rendering.raycast import RayCaster

_LAYERS = 3  # voxels in front of and behind the surface
_GRAZING = 0.25  # cosine below which a view sees nothing
_WAVES = 5
_SHORTEST = 4.0  # of a wave of noise, millimetres


@dataclass(frozen=True)
class DepthNoise:
    """Errors of one view's depth: waves of ``amplitude`` millimetres with lengths of 4 mm to ``longest``,
    and ``grain`` from point to point."""

    amplitude: float = 0.12
    longest: float = 25.0
    grain: float = 0.05


def fuse(
    mesh: Mesh, eyes: Tensor, voxel: float, noise: DepthNoise, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """What viewers at ``eyes`` (E,3) see of a mesh: vertices (V,3), faces (F,3); what nobody sees is a hole.

    The truncated signed distance along each viewing ray is averaged over the views in the voxels round the surface;
    its zero becomes triangles by surface nets.

    Source: Curless and Levoy 1996; Gibson 1998 (surface nets).
    """
    caster = RayCaster(mesh.vertices, mesh.faces)
    face_normals = triangle_normals(mesh.vertices.double(), mesh.faces)
    points, normals = _visible_points(mesh, caster, face_normals, eyes.double(), voxel)
    origin = points.amin(0) - (_LAYERS + 2) * voxel
    shape = ((points.amax(0) + (_LAYERS + 2) * voxel - origin) / voxel).ceil().long() + 1
    cells, facing = _shell(points, normals, origin, voxel, shape)
    centres = origin + voxel * _unravel(cells, shape).double()
    total, weight = torch.zeros(len(cells), dtype=torch.float64), torch.zeros(len(cells), dtype=torch.float64)
    for eye in eyes.double():  # a view a turn: all at once would take gigabytes
        way = torch.nn.functional.normalize(eye - centres, dim=-1)
        seen = ((facing * way).sum(-1) > 0.0).nonzero()[:, 0]
        distance, strength = _depth(caster, face_normals, eye, centres[seen], noise, generator)
        gap = distance - (eye - centres[seen]).norm(dim=-1)
        good = (gap > -_LAYERS * voxel) & (strength > _GRAZING)
        rows = seen[good]
        total[rows] += strength[good] * gap[good].clamp(max=_LAYERS * voxel)
        weight[rows] += strength[good]
    known = weight > 0
    if not known.any():
        raise ValueRangeError("fuse: found nothing that any view sees, expected a surface in front of the eyes")
    return surface_net(cells[known], total[known] / weight[known], shape, origin, voxel)


def surface_net(cells: Tensor, values: Tensor, shape: Tensor, origin: Tensor, voxel: float) -> tuple[Tensor, Tensor]:
    """The zero of values at a grid's cells, row-major, ascending, (N,) both, as triangles facing the positive side.

    Vertices (V,3) and faces (F,3): a vertex in each cube with both signs, a quad (two triangles) round each edge.
    """
    strides = torch.tensor([int(shape[1] * shape[2]), int(shape[2]), 1])
    offsets = torch.tensor([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    lookup = torch.full((int(shape.prod()) + int(strides.sum()) + 1,), -1, dtype=torch.int32)
    lookup[cells] = torch.arange(len(cells), dtype=torch.int32)
    around = lookup[cells[:, None] + (offsets * strides).sum(1)].long()
    whole = (around >= 0).all(1)
    corner_values = values[around.clamp(min=0)]
    mixed = whole & ((corner_values < 0).any(1) & (corner_values >= 0).any(1))
    cubes, corner_values = cells[mixed], corner_values[mixed]
    vertices = origin + voxel * (_unravel(cubes, shape).double() + _crossing_mean(corner_values, offsets.double()))
    lookup.fill_(-1)
    lookup[cubes] = torch.arange(len(cubes), dtype=torch.int32)
    quads = []
    for axis in range(3):
        u, v = strides[(axis + 1) % 3], strides[(axis + 2) % 3]
        # The edge from a cube's first corner along the axis; four cubes touch it.
        first, last = corner_values[:, 0], corner_values[:, [4, 2, 1][axis]]
        crossing = (first < 0) != (last < 0)
        base = cubes[crossing]
        ring = torch.stack([base, base - u, base - u - v, base - v], dim=1)
        ids = lookup[ring.clamp(min=0)].long()
        flip = (first < 0)[crossing]
        ids = torch.where(flip[:, None], ids, ids.flip(1))
        quads.append(ids[(ids >= 0).all(1) & (ring >= 0).all(1)])
    quad = torch.cat(quads)
    faces = torch.cat([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    used, faces = faces.unique(return_inverse=True)
    return vertices[used], faces


def _crossing_mean(values: Tensor, offsets: Tensor) -> Tensor:
    """Mean (N,3) of where the twelve edges of unit cubes with corner values (N,8) cross zero."""
    total, count = torch.zeros(len(values), 3, dtype=torch.float64), torch.zeros(len(values), 1, dtype=torch.float64)
    for a in range(8):
        for b in (a ^ 1, a ^ 2, a ^ 4):
            if b < a:
                continue
            crossing = (values[:, a] < 0) != (values[:, b] < 0)
            gap = values[:, a] - values[:, b]
            share = values[:, a] / torch.where(gap == 0, 1.0, gap)
            place = offsets[a] + share[:, None] * (offsets[b] - offsets[a])
            total += torch.where(crossing[:, None], place, 0.0)
            count += crossing[:, None]
    return total / count.clamp(min=1)


def _depth(
    caster: RayCaster, face_normals: Tensor, eye: Tensor, targets: Tensor, noise: DepthNoise, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Noisy distance (N,) from an eye to the surface on the way to targets (N,3), and the cosine of incidence (N,)."""
    way = torch.nn.functional.normalize(targets - eye, dim=-1)
    hits = caster.cast(eye.expand_as(way), way)
    cosine = -(face_normals[hits.triangle.clamp(min=0)] * way).sum(-1)
    cosine = torch.where(hits.triangle >= 0, cosine, 0.0)
    place = eye + way * hits.distance.clamp(max=1e6)[:, None]
    error = torch.randn(len(way), generator=generator, dtype=torch.float64) * noise.grain
    for _ in range(_WAVES):
        heading = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
        draw = torch.rand(2, generator=generator, dtype=torch.float64)
        length = _SHORTEST * (noise.longest / _SHORTEST) ** float(draw[0])
        phase = place @ heading * (2 * math.pi / length) + 2 * math.pi * draw[1]
        error = error + noise.amplitude * math.sqrt(2 / _WAVES) * phase.sin()
    return hits.distance + error, cosine


def _visible_points(
    mesh: Mesh, caster: RayCaster, face_normals: Tensor, eyes: Tensor, voxel: float
) -> tuple[Tensor, Tensor]:
    """Points (N,3) that some eye sees, closer together than voxels, and the normals there, toward that eye."""
    low, high = mesh.vertices.double().aminmax(dim=0)
    middle, reach = (low + high) / 2, float((high - low).norm()) / 2
    along = torch.arange(-reach, reach, voxel, dtype=torch.float64)
    across = torch.cartesian_prod(along, along)
    points, normals = [], []
    for eye in eyes:
        toward = torch.nn.functional.normalize(middle - eye, dim=0)
        helper = torch.nn.functional.one_hot(toward.abs().argmin(), 3).double()
        side = torch.nn.functional.normalize(torch.linalg.cross(helper, toward), dim=0)
        targets = middle + across[:, :1] * side + across[:, 1:] * torch.linalg.cross(toward, side)
        way = torch.nn.functional.normalize(targets - eye, dim=-1)
        hits = caster.cast(eye.expand_as(way), way)
        seen = hits.triangle >= 0
        normal = face_normals[hits.triangle[seen]]
        facing = (normal * way[seen]).sum(-1) < 0
        points.append((eye + way[seen] * hits.distance[seen, None])[facing])
        normals.append(normal[facing])
    if not sum(map(len, points)):
        raise ValueRangeError("fuse: found nothing that any view sees, expected a surface in front of the eyes")
    return torch.cat(points), torch.cat(normals)


def _shell(points: Tensor, normals: Tensor, origin: Tensor, voxel: float, shape: Tensor) -> tuple[Tensor, Tensor]:
    """Grid points within the layers of the surface, ascending, (N,), and a surface normal near each, (N,3)."""
    strides = torch.tensor([int(shape[1] * shape[2]), int(shape[2]), 1])
    cell = ((points - origin) / voxel).round().long()
    count = int(shape.prod())
    # numpy: where several points share a voxel the last one wins, always; torch's threads would race.
    owner = np.full(count, -1, dtype=np.int32)
    owner[(cell * strides).sum(1).numpy()] = np.arange(len(points), dtype=np.int32)
    for _ in range(_LAYERS):  # grows by one voxel a round
        filled = np.flatnonzero(owner >= 0)
        held = owner[filled]
        for step in strides.tolist():
            for move in (step, -step):
                to = filled + move
                free = owner[to] < 0
                owner[to[free]] = held[free]
    cells = np.flatnonzero(owner >= 0)
    return torch.from_numpy(cells), normals[torch.from_numpy(owner[cells].astype(np.int64))]


def _unravel(indices: Tensor, shape: Tensor) -> Tensor:
    plane, row = int(shape[1] * shape[2]), int(shape[2])
    return torch.stack([indices // plane, indices % plane // row, indices % row], dim=-1)
