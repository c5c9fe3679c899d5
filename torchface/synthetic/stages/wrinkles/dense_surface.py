"""A coarse face made dense by subdivision, as matrices that take coarse vertices to dense points and tangents."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.geometry.meshes.operators import edges, triangle_areas, vertex_normals
from torchface.geometry.meshes.uv_seams import merge_equal_rows
from torchface.mesh import Annotations, Mesh, fan_triangulation
from torchface.synthetic.stages.subdivision import corner_uvs, divided_corner_values, subdivision_operator

_BLUNT = 1e-3  # of a ring's spread: keeps the gradient finite where a ring is a line, as at the corners of lips


@dataclass(frozen=True, eq=False)
class DenseSurface:
    """A smooth surface over a coarse mesh."""

    neutral: Mesh  # the dense mesh without wrinkles or pores; the coarse vertices come first, in their order
    operator: sparse.csr_array  # from coarse vertices to dense ones, (V,V0), float32
    # From coarse vertices to two tangents a dense vertex, (2V,V0), float32: how two fixed directions in the skin have
    # been moved and stretched; the first V rows are the first direction's.
    tangents: sparse.csr_array


def dense_surface(coarse: Mesh, vertices: int) -> DenseSurface:
    """Rounds of Catmull-Clark; the last one only where the face moves, so that there are about ``vertices``.

    Every dense vertex is a vertex of the whole last round. Quads that are not divided keep the middles of edges that
    their neighbours have, so the surface has no cracks.

    Source: Catmull and Clark 1978.
    """
    polygons = coarse.faces if coarse.polygons is None else coarse.polygons
    uvs = corner_uvs(coarse, polygons)
    operator = sparse.eye_array(len(coarse.vertices), format="csr")
    step, quads = subdivision_operator(polygons, len(coarse.vertices))
    while step.shape[0] <= vertices or bool((polygons < 0).any()):
        uvs = None if uvs is None else divided_corner_values(polygons, uvs)
        operator, polygons = step @ operator, quads
        step, quads = subdivision_operator(polygons, operator.shape[0])
    places = torch.from_numpy(operator @ coarse.vertices.double().numpy())
    wanted = max(0, round((vertices - operator.shape[0]) / 3))
    order = _importance(places, polygons, coarse).argsort(descending=True)
    divided = torch.zeros(len(polygons), dtype=torch.bool)
    divided[order[:wanted]] = True
    corners, corner_uv = _partly_divided(polygons, quads.view(-1, polygons.shape[1], 4), uvs, divided)
    held = torch.arange(len(coarse.vertices))  # those without a face as well: ids of the coarse mesh stay
    used, row = torch.cat([held, corners.clamp(min=0).flatten()]).unique(return_inverse=True)
    polygons = row[len(held) :].view_as(corners).masked_fill(corners < 0, -1)
    operator = (step[used.numpy()] @ operator).tocsr()
    mesh = _mesh(operator, polygons, corner_uv, coarse)
    tangents = sparse.vstack([matrix @ operator for matrix in _gradients(mesh)], format="csr")
    return DenseSurface(mesh, operator.astype(np.float32), tangents.astype(np.float32))


def _importance(places: Tensor, quads: Tensor, coarse: Mesh) -> Tensor:
    """The longest edges of the front of the face come first, (Q,)."""
    marks = coarse.vertices[coarse.landmarks].double()
    low, high = marks.amin(0), marks.amax(0)
    size = high - low
    centre = (low + high) / 2 + 0.12 * size * torch.tensor([0.0, 1.0, 0.0])
    radius = size * torch.tensor([0.5, 0.68, 0.6])
    corner = places[quads]
    offset = (corner.mean(1) - centre) / radius
    away = torch.maximum(offset[:, :2].norm(dim=1), offset[:, 2].abs())
    return (corner - corner.roll(-1, 1)).norm(dim=-1).mean(1) * ((1.0 - away) / 0.1).sigmoid()


def _partly_divided(
    polygons: Tensor, children: Tensor, uvs: Tensor | None, divided: Tensor
) -> tuple[Tensor, Tensor | None]:
    """Polygons (P,8), padded with -1, of which some (Q,) are divided into quads (Q,K,4), and their corners' texture
    coordinates (P,8,2)."""
    middles = children[..., 1]
    has_middle = torch.zeros(int(children.max()) + 1, dtype=torch.bool)
    has_middle[middles[divided]] = True
    divided = divided | has_middle[middles].all(1)
    has_middle[middles[divided]] = True
    hanging = has_middle[middles[~divided]]
    # A fan from an edge's middle has no flat triangle; so a polygon with such an edge starts there.
    width = polygons.shape[1]
    turn = (hanging.int().argmax(1)[:, None] + torch.arange(width)) % width
    following = (turn + 1) % width
    whole, middle = polygons[~divided], middles[~divided]
    slots = torch.stack(
        [middle.gather(1, turn).masked_fill(~hanging.gather(1, turn), -1), whole.gather(1, following)], -1
    ).flatten(1)
    packed = (slots < 0).int().argsort(dim=1, stable=True)
    kept = slots.gather(1, packed)
    small = children[divided].flatten(0, 1)
    small = torch.cat([small, torch.full((len(small), 2 * width - 4), -1)], dim=1)
    if uvs is None:
        return torch.cat([kept, small]), None
    own, fine = uvs[~divided], divided_corner_values(polygons[divided], uvs[divided])
    pick = lambda values, index: values.gather(1, index[..., None].expand(-1, -1, 2))  # noqa: E731
    start, end = pick(own, turn), pick(own, following)
    laid = pick(torch.stack([(start + end) / 2, end], 2).flatten(1, 2), packed)
    fine = torch.cat([fine, torch.zeros(len(fine), 2 * width - 4, 2, dtype=fine.dtype)], dim=1)
    return torch.cat([kept, small]), torch.cat([laid, fine])


def _mesh(operator: sparse.csr_array, polygons: Tensor, corner_uv: Tensor | None, coarse: Mesh) -> Mesh:
    vertices = torch.from_numpy(operator @ coarse.vertices.double().numpy()).float()
    faces = fan_triangulation(polygons)
    uvs = uv_faces = None
    if corner_uv is not None:
        valid = polygons >= 0
        rows = torch.cat([polygons[valid].double()[:, None], corner_uv[valid].double()], dim=1)
        inverse, first = merge_equal_rows(rows.numpy())
        row = torch.full_like(polygons, -1)
        row[valid] = torch.from_numpy(inverse)
        uvs, uv_faces = rows[torch.from_numpy(first), 1:].float(), fan_triangulation(row)
    marks = coarse.annotations
    inside = {} if marks is None else marks.regions
    regions = {
        name: torch.from_numpy(operator @ mask.double().numpy()) > 0.5 for name, mask in inside.items() if mask.any()
    }
    return Mesh(vertices, faces, uvs, uv_faces, annotations=Annotations(coarse.landmarks, regions))


def _gradients(mesh: Mesh) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Derivatives of values at the vertices along two directions in the skin, (V,V) each; least squares in a ring."""
    vertices = mesh.vertices.double()
    normals = vertex_normals(vertices, mesh.faces)
    first, second = tangent_directions(normals)
    pair = edges(mesh.faces)
    start, end = torch.cat([pair, pair.flip(1)]).T
    way = vertices[end] - vertices[start]
    offset = torch.stack([(way * first[start]).sum(1), (way * second[start]).sum(1)], dim=1)
    weight = 1 / way.square().sum(1).clamp(min=1e-12)
    count = len(vertices)
    spread = torch.zeros(count, 2, 2, dtype=torch.float64)
    spread.index_add_(0, start, weight[:, None, None] * offset[:, :, None] * offset[:, None, :])
    trace = spread.diagonal(dim1=1, dim2=2).sum(1).clamp(min=1e-9)
    spread = spread + _BLUNT * trace[:, None, None] * torch.eye(2, dtype=torch.float64)
    slope = torch.linalg.solve(spread[start], (weight[:, None] * offset)[..., None])[..., 0]
    matrices = []
    for k in range(2):
        own = torch.zeros(count, dtype=torch.float64).index_add_(0, start, slope[:, k])
        across = sparse.csr_array((slope[:, k].numpy(), (start.numpy(), end.numpy())), shape=(count, count))
        matrices.append((across - sparse.diags_array(own.numpy())).tocsr())
    return matrices[0], matrices[1]


def tangent_directions(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit directions (V,3) square to each normal: the first level and toward the face's left, then upward."""
    helper = torch.where(
        normals[:, 1:2].abs() > 0.9, normals.new_tensor([[1.0, 0, 0]]), normals.new_tensor([[0, 1.0, 0]])
    )
    first = torch.nn.functional.normalize(torch.linalg.cross(helper.expand_as(normals), normals), dim=1)
    return first, torch.linalg.cross(normals, first)


def vertex_spacing(mesh: Mesh) -> Tensor:
    """How far apart neighbouring vertices stand, millimetres, (V,)."""
    area = triangle_areas(mesh.vertices, mesh.faces)
    corner = mesh.faces.flatten()
    count = len(mesh.vertices)
    total = area.new_zeros(count, dtype=torch.float32).index_add_(0, corner, area.float().repeat_interleave(3) / 3)
    return total.clamp(min=1e-6).sqrt()
