"""A coarse mesh made smooth and fine, its texture turned into vertex colours: what a scanner looks at."""

import torch
from scipy import sparse
from torch import Tensor

from torchface.mesh import Mesh
from torchface.rendering.clay_shading import sample_texture
from torchface.rendering.part_colors import CLAY

_MAX_FACES = 1_000_000
_INTERPOLATION_ITERATIONS = 6


def finely_coloured(mesh: Mesh, edge: float) -> Mesh:
    """A smooth surface through the vertices of a mesh, with edges of about ``edge`` millimetres and a colour a vertex.

    Catmull-Clark subdivision of control points that are moved until the surface passes through the mesh's own vertices,
    to within some hundredths of a millimetre; they come first, in their order.

    Source: Catmull and Clark 1978; Chen et al. 2008, Progressive Interpolation using Catmull-Clark Subdivision.
    """
    polygons = mesh.faces if mesh.polygons is None else mesh.polygons
    vertices, colors = mesh.vertices.double(), mesh.colors
    uvs = corner_uvs(mesh, polygons)
    control = vertices
    for _ in range(_INTERPOLATION_ITERATIONS):
        coarse, quads, _ = catmull_clark(control, polygons)
        finer, _, _ = catmull_clark(coarse, quads)
        control = control + (mesh.vertices.double() - finer[: len(vertices)])
    vertices = control
    while len(polygons) * 4 <= _MAX_FACES and _typical_edge(vertices, polygons) > edge:
        attributes = vertices if colors is None else torch.cat([vertices, colors.double()], dim=1)
        attributes, polygons, uvs = catmull_clark(attributes, polygons, uvs)
        vertices = attributes[:, :3]
        colors = None if colors is None else attributes[:, 3:]
    if uvs is not None and mesh.texture is not None:
        valid = polygons >= 0
        colors = torch.zeros(len(vertices), 3)
        colors[polygons[valid]] = sample_texture(mesh.texture, uvs[valid].float())
    if colors is None:
        colors = torch.tensor(CLAY).expand(len(vertices), 3)
    return Mesh.from_polygons(vertices.float(), polygons, colors=colors.float().clamp(0, 1))


def catmull_clark(
    values: Tensor, polygons: Tensor, corner_values: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """One round of subdivision.

    Args:
        values: at the vertices, (V,D); position comes first where there is more.
        polygons: (P,K) int64, padded with -1.
        corner_values: at each polygon's corners (P,K,E), divided linearly, such as texture coordinates.

    Returns:
        Values (V',D), the first V of them the old vertices', quads (Q,4), and corner values (Q,4,E).
    """
    operator, quads = subdivision_operator(polygons, len(values))
    result = torch.from_numpy(operator @ values.double().numpy()).to(values.dtype)
    if corner_values is None:
        return result, quads, None
    return result, quads, divided_corner_values(polygons, corner_values)


def divided_corner_values(polygons: Tensor, corner_values: Tensor) -> Tensor:
    """Values (Q,4,E) at the corners of the quads that a round makes of polygons (P,K), padded with -1, divided
    linearly."""
    after, before, sides, valid = _neighbouring_slots(polygons)
    corner = corner_values.masked_fill(~valid[..., None], 0.0)
    centre = (corner.sum(1) / sides[:, None])[:, None].expand_as(corner)
    spread = corner.shape[-1]
    forward = (corner + corner.gather(1, after[..., None].expand(-1, -1, spread))) / 2
    backward = (corner + corner.gather(1, before[..., None].expand(-1, -1, spread))) / 2
    return torch.stack([corner, forward, centre, backward], dim=2)[valid]


def subdivision_operator(polygons: Tensor, count: int) -> tuple[sparse.csr_array, Tensor]:
    """What one round does to values at V vertices: a matrix (V',V), for the round is linear in them, and quads (Q,4).

    Rows are the old vertices, then a point an edge, then a point a polygon; a quad holds an old vertex, the point of
    the edge after it, the polygon's, that of the edge before it.
    """
    after, before, _, valid = _neighbouring_slots(polygons)
    width = polygons.shape[1]
    successor = polygons.gather(1, after)
    face_of = torch.arange(len(polygons))[:, None].expand(-1, width)[valid]
    start, end = polygons[valid], successor[valid]
    keys, edge = (torch.minimum(start, end) * count + torch.maximum(start, end)).unique(return_inverse=True)
    ends = torch.stack([keys // count, keys % count], dim=1)
    uses = edge.bincount(minlength=len(ends))
    edge_row = torch.arange(len(ends))
    face_point = _averages(face_of, start, len(polygons), count)
    middle = _averages(edge_row.repeat_interleave(2), ends.flatten(), len(ends), count)
    inner = (uses == 2).double()
    edge_point = _scaled(1 - inner / 2, middle) + _scaled(
        inner / 2, _averages(edge, face_of, len(ends), len(polygons)) @ face_point
    )
    valence = start.bincount(minlength=count).clamp(min=1).double()
    around = _averages(start, face_of, count, len(polygons)) @ face_point
    beside = _averages(ends.flatten(), edge_row.repeat_interleave(2), count, len(ends)) @ middle
    rim = ends[uses == 1]
    on_rim = torch.zeros(count, dtype=torch.bool)
    on_rim[rim.flatten()] = True
    rim_row = edge_row[uses == 1].repeat_interleave(2)
    rim_beside = _averages(rim.flatten(), rim_row, count, len(ends)) @ middle
    free = torch.ones(count, dtype=torch.bool)
    free[start] = False
    bends = (~on_rim & ~free).double()
    kept = bends * (valence - 3) / valence + 0.5 * on_rim.double() + free.double()
    moved = (
        sparse.diags_array(kept.numpy())
        + _scaled(bends / valence, around)
        + _scaled(2 * bends / valence, beside)
        + _scaled(0.5 * on_rim.double(), rim_beside)
    )
    edge_ids = torch.full_like(polygons, -1)
    edge_ids[valid] = edge + count
    previous = edge_ids.gather(1, before)
    middle_ids = (torch.arange(len(polygons)) + count + len(ends))[:, None].expand(-1, width)
    quads = torch.stack([polygons, edge_ids, middle_ids, previous], dim=-1)[valid]
    return sparse.vstack([moved, edge_point, face_point], format="csr"), quads


def _neighbouring_slots(polygons: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where each corner's successor and predecessor stand, (P,K) twice, corners a polygon (P,), and which are any."""
    valid = polygons >= 0
    sides = valid.sum(1)
    slot = torch.arange(polygons.shape[1])
    after = torch.where(slot + 1 < sides[:, None], slot + 1, 0)
    before = torch.where(slot > 0, slot - 1, sides[:, None] - 1)
    return after, before, sides, valid


def _averages(row: Tensor, column: Tensor, rows: int, columns: int) -> sparse.csr_array:
    """The matrix whose rows are means over the columns that are named beside them."""
    share = 1 / row.bincount(minlength=rows).clamp(min=1).double()
    return sparse.csr_array((share[row].numpy(), (row.numpy(), column.numpy())), shape=(rows, columns))


def _scaled(factors: Tensor, matrix: sparse.csr_array) -> sparse.csr_array:
    return sparse.diags_array(factors.numpy()) @ matrix


def corner_uvs(mesh: Mesh, polygons: Tensor) -> Tensor | None:
    """Texture coordinates at polygon corners (P,K,2), read off the fan triangles."""
    if mesh.uvs is None or mesh.uv_faces is None:
        return None
    uvs = mesh.uvs.double()
    corner = torch.zeros(*polygons.shape, 2, dtype=torch.float64)
    triangles = (polygons >= 0).sum(1) - 2
    first = triangles.cumsum(0) - triangles
    corner[:, 0], corner[:, 1] = uvs[mesh.uv_faces[first, 0]], uvs[mesh.uv_faces[first, 1]]
    for k in range(polygons.shape[1] - 2):
        row = (first + k).clamp(max=len(mesh.uv_faces) - 1)
        corner[:, k + 2] = uvs[mesh.uv_faces[row, 2]]
    return corner


def _typical_edge(vertices: Tensor, polygons: Tensor) -> float:
    return float((vertices[polygons[:, 0]] - vertices[polygons[:, 1]]).norm(dim=-1).median())
