"""A scan's colours on the registered mesh: one a vertex, and a texture in the template's layout."""

import math
from dataclasses import dataclass, replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.color_space import to_linear
from torchface.errors import TopologyError
from torchface.geometry.meshes.operators import components, vertex_normals
from torchface.geometry.meshes.rasterization import interpolate, rasterise_uvs
from torchface.geometry.meshes.surface_index import SurfacePoints
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import sample_texture, vertex_openness
from torchface.rendering.raycast import RayCaster

_REACH = 5.0
_BLEND = 10.0
_MAX_ANGLE = 75.0
_LEAST, _FINEST = 0.02, 5.0  # of a colour; times brighter or darker than between vertices
_DARK = 0.25  # of the skin's light
_OPEN, _DEEP = 0.5, 0.3  # how open a place is, of 1, from which it is not in shade; of the skin's colour, at least
_STRANDS, _SHADOW = 3, 2  # rings of vertices


@dataclass(frozen=True, eq=False)
class ScanColors:
    """Where a scan's colours are looked up."""

    scan: Mesh  # the scan as it came, with a texture or vertex colours
    vertices: Tensor  # (V',3)
    faces: Tensor  # triangles of vertices that are registered to, (F',3), the right side out
    face_ids: Tensor  # the scan's own row of each, (F',)

    def at(self, triangle: Tensor, barycentric: Tensor) -> Tensor:
        """Colours (Q,3) at barycentric coordinates (Q,3) of rows (Q,) of ``faces``."""
        rows, barycentric = self.face_ids[triangle], self._own_order(barycentric)
        scan = self.scan
        if scan.texture is not None and scan.uvs is not None and scan.uv_faces is not None:
            uv = interpolate(scan.uvs.cpu().double(), scan.uv_faces.cpu()[rows], barycentric)
            return sample_texture(scan.texture.cpu(), uv)
        assert scan.colors is not None
        return interpolate(scan.colors.cpu().double(), scan.faces.cpu()[rows], barycentric).float()

    def _own_order(self, barycentric: Tensor) -> Tensor:
        """Barycentric coordinates in the order of the scan's own corners: turned triangles have them backwards."""
        corner = self.scan.vertices.cpu().double()[self.scan.faces.cpu()[self.face_ids[:1], 0]]
        same = torch.equal(corner, self.vertices[self.faces[:1, 0]])
        return barycentric if same else barycentric.flip(1)


def has_colors(scan: Mesh) -> bool:
    """Whether a scan brings a texture that its coordinates reach, or vertex colours."""
    return scan.colors is not None or (scan.texture is not None and scan.uvs is not None)


def without_colors(scan: Mesh) -> Mesh:
    """The scan without texture and vertex colours."""
    return replace(scan, colors=None, texture=None)


def vertex_colors(source: ScanColors, nearest: SurfacePoints, trusted: Tensor) -> Tensor:
    """Colours (V,3) of the registered mesh's vertices; one not on the scan, not in ``trusted``, has its neighbour's."""
    colors = source.at(nearest.triangle, nearest.barycentric)
    if trusted.any() and not trusted.all():
        known = nearest.points[trusted]
        _, row = cKDTree(known.numpy()).query(nearest.points[~trusted].numpy())
        colors[~trusted] = colors[trusted][torch.from_numpy(row)]
    return colors.clamp(0, 1)


def in_shade(colors: Tensor, mesh: Mesh, matched: Tensor) -> Tensor:
    """Colours (V,3) of a mesh's vertices, darker inside nostrils and the mouth, where nothing is ``matched``, (V,)."""
    shade = (vertex_openness(mesh) / _OPEN).clamp(_DEEP, 1)
    return colors * torch.where(matched, 1.0, shade)[:, None]


def skin_base(colors: Tensor, template: Mesh, seen: Tensor) -> Tensor:
    """What is painted where nothing is seen, (V,3): the template's colours in the person's tone, else skin colour."""
    label = components(template.faces.cpu(), len(colors))
    seen = seen & (label == label.bincount().argmax())  # neither a shirt nor hair
    skin, own = colors[seen].median(0).values if seen.any() else colors.mean(0), own_colors(template)
    if own is None:
        return skin.expand(len(colors), 3)
    own = own.to(colors)
    return (own * (skin / own[seen].median(0).values.clamp(min=1e-3))).clamp(0, 1) if seen.any() else own


def own_colors(mesh: Mesh) -> Tensor | None:
    """Vertex colours (V,3) of a mesh: its own, else those of its texture."""
    if mesh.colors is not None:
        return mesh.colors.detach().cpu().float()
    if mesh.texture is None or mesh.uvs is None or mesh.uv_faces is None:
        return None
    row = torch.zeros(len(mesh.vertices), dtype=torch.int64)
    row[mesh.faces.cpu().flatten()] = mesh.uv_faces.cpu().flatten()
    return sample_texture(mesh.texture.cpu(), mesh.uvs.cpu()[row])


def shown_share(vertices: Tensor, unseen: Tensor) -> Tensor:
    """How much of each vertex's colour is the scan's, (V,) in [0,1]: 0 where unseen, 1 from 10 mm away on."""
    if not unseen.any():
        return torch.ones(len(vertices))
    gap, _ = cKDTree(vertices[unseen].numpy()).query(vertices.numpy())
    ramp = (torch.from_numpy(gap).float() / _BLEND).clamp(0, 1)
    return ramp.square() * (3 - 2 * ramp)


def with_edge_of_hair(unseen: Tensor, shown: Tensor, matched: Tensor, faces: Tensor) -> Tensor:
    """Unseen vertices (V,) and those beside them that hair covers or darkens: what is dark up to the first
    ``matched`` skin."""
    if not matched.any() or not unseen.any():
        return unseen
    light = to_linear(shown.double()).mean(1)
    dark, graph = light < _DARK * light[matched].median(), VertexGraph(faces, len(shown))

    def beside(mask: Tensor) -> Tensor:
        return graph.sum(mask.double()[:, None])[:, 0] > 0

    covered = unseen
    for _ in range(_STRANDS):  # rings of neighbours
        covered = covered | (dark & beside(covered))
    edge = dark & covered
    for _ in range(_SHADOW):
        edge = edge | beside(edge)
    return covered | edge


def resampled_texture(
    mesh: Mesh, template: Mesh, colors: Tensor, shown: Tensor, source: ScanColors, size: int
) -> Tensor:
    """A texture (3,size,size) in the mesh's own layout.

    From each texel's place on the registered mesh a ray goes out and one in along the normal; the nearer hit within
    5 mm whose surface faces the same way gives the colour. Where there is none, the vertex colours do, and they take
    over where the scan does not show the skin, with what the template's texture has between vertices. Charts are
    widened by four texels, so that no background shows at their seams.
    """
    if mesh.uvs is None or mesh.uv_faces is None:
        raise TopologyError("mesh: found no texture coordinates, expected some to lay a texture out in")
    texels = rasterise_uvs(mesh.uvs.cpu(), mesh.uv_faces.cpu(), size, size)
    faces, vertices = mesh.faces.cpu(), mesh.vertices.detach().cpu().double()
    points = texels.interpolate(vertices, faces)
    normals = torch.nn.functional.normalize(texels.interpolate(vertex_normals(vertices, faces), faces), dim=-1)
    values = texels.interpolate(colors.double(), faces).float()
    share = texels.interpolate(shown[:, None].double(), faces).float()
    own = own_colors(replace(template, colors=None))
    if own is not None and template.texture is not None:
        places = texels.interpolate(mesh.uvs.cpu().double(), mesh.uv_faces.cpu())
        fine = sample_texture(template.texture.cpu()[:3], places)
        fine = fine / texels.interpolate(own.double(), faces).float().clamp(min=_LEAST)
        values = values * torch.lerp(fine.clamp(1 / _FINEST, _FINEST), torch.ones_like(fine), share)
    wanted = (share[:, 0] > 0).nonzero()[:, 0]
    triangle, barycentric, hit = _along_normals(source, points[wanted], normals[wanted])
    rows = wanted[hit]
    values[rows] = torch.lerp(values[rows], source.at(triangle[hit], barycentric[hit]), share[rows])
    return texels.image(values.clamp(0, 1))


def _along_normals(source: ScanColors, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    caster = RayCaster(source.vertices, source.faces)
    surface = vertex_normals(source.vertices, source.faces)
    best = torch.full((len(points),), _REACH, dtype=torch.float64)
    triangle = torch.full((len(points),), -1, dtype=torch.int64)
    barycentric = torch.zeros(len(points), 3, dtype=torch.float64)
    for way in (normals, -normals):
        hits = caster.cast(points, way)
        there = interpolate(surface, source.faces[hits.triangle.clamp(min=0)], hits.barycentric.double())
        alike = (there * normals).sum(-1) > math.cos(math.radians(_MAX_ANGLE)) * there.norm(dim=-1)
        better = (hits.triangle >= 0) & alike & (hits.distance < best)
        best = torch.where(better, hits.distance, best)
        triangle = torch.where(better, hits.triangle, triangle)
        barycentric = torch.where(better[:, None], hits.barycentric.double(), barycentric)
    return triangle, barycentric, triangle >= 0
