"""Mesh: quads and their triangles belong together, parts keep what they had, broken input is named."""

import pytest
import torch

from torchface import Attachment, BlendshapeRig
from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.mesh import Annotations, Mesh, fan_triangulation, submesh


def grid(columns: int = 4, rows: int = 3) -> Mesh:
    """A flat sheet of quads with one triangle at its end, a seam in its texture and all annotations."""
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    vertices = torch.stack([x, y, x * y], dim=-1).reshape(-1, 3).float()
    corner = (y[:-1, :-1] * columns + x[:-1, :-1]).reshape(-1)
    polygons = torch.stack([corner, corner + 1, corner + columns + 1, corner + columns], dim=1)
    polygons[-1, 3] = -1
    uv_polygons = polygons.clone()
    uv_polygons[0, 0] = len(vertices)
    uvs = torch.cat([vertices[:, :2] / 10, torch.tensor([[0.9, 0.9]])])
    annotations = Annotations(
        landmarks=torch.tensor([1, 2]),
        regions={"left": vertices[:, 0] < 2},
        mirror=(y * columns + (columns - 1 - x)).reshape(-1),
        contacts=torch.tensor([[0, 3], [1, 2]]),
    )
    return Mesh.from_polygons(
        vertices, polygons, uvs, uv_polygons, colors=vertices.clamp(0, 1), annotations=annotations
    )


def test_fan_covers_each_polygon_once() -> None:
    polygons = torch.tensor([[0, 1, 2, 3, 4], [5, 6, 7, -1, -1], [8, 9, 10, 11, -1]])
    expected = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [5, 6, 7], [8, 9, 10], [8, 10, 11]]
    assert fan_triangulation(polygons).tolist() == expected


def test_part_keeps_positions_seams_and_masks() -> None:
    mesh = grid()
    piece = submesh(mesh, mesh.vertices[:, 0] < 3)
    part, ids = piece.mesh, piece.vertex_ids
    assert torch.equal(part.vertices, mesh.vertices[ids])
    assert torch.equal(ids[part.polygons.clamp(min=0)].sort(1).values[:, -1] % 4 < 3, torch.ones(4, dtype=torch.bool))
    kept = (mesh.vertices[mesh.faces][..., 0] < 3).all(-1)
    assert torch.equal(ids[part.faces], mesh.faces[kept])
    assert torch.equal(part.uvs[part.uv_faces], mesh.uvs[mesh.uv_faces[kept]])
    assert torch.equal(ids[part.annotations.landmarks], torch.tensor([1, 2]))
    assert part.annotations.mirror is None  # its other half is gone
    assert part.annotations.contacts.tolist() == [[1, 2]]


def test_vertices_of_whole_numbers_are_positions_like_others() -> None:
    sheet = grid()
    whole = sheet.with_vertices(sheet.vertices.long())
    assert torch.equal(whole.vertices, sheet.vertices)
    posed = BlendshapeRig(whole, torch.full((1, 12, 3), 0.75), ["up"])(torch.tensor([[0.5]]))
    torch.testing.assert_close(posed[0], sheet.vertices + 0.375)
    middle = Attachment(torch.tensor([0]), torch.tensor([[0.5, 0.25, 0.25]]))
    assert torch.equal(middle.on(whole.faces, sheet.vertices.long()), middle.on(sheet.faces, sheet.vertices))


def test_a_mesh_without_vertices_is_refused() -> None:
    with pytest.raises(TopologyError, match="found no vertices"):
        Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64))


def test_part_by_ids_equals_part_by_mask() -> None:
    mesh = grid()
    mask = mesh.vertices[:, 1] < 2
    assert torch.equal(submesh(mesh, mask).mesh.faces, submesh(mesh, mask.nonzero()[:, 0]).mesh.faces)


def test_fingerprint_is_of_the_topology_alone() -> None:
    mesh = grid()
    assert mesh.with_vertices(mesh.vertices * 2).fingerprint() == mesh.fingerprint()
    assert Mesh(mesh.vertices, mesh.faces.flip(0)).fingerprint() != mesh.fingerprint()


def test_a_mesh_of_another_topology_is_described() -> None:
    mesh = grid()
    mesh.require_topology(mesh.with_vertices(2 * mesh.vertices), "a", "b")
    loose = Mesh(torch.cat([mesh.vertices, mesh.vertices[:1]]), mesh.faces)
    with pytest.raises(TopologyError, match=r"a: found 13 vertices and 11 .* b, 12 vertices and 11 triangles,"):
        loose.require_topology(mesh, "a", "b")
    with pytest.raises(TopologyError, match="expected those of b, 12 vertices and other triangles, in their order"):
        Mesh(mesh.vertices, mesh.faces.flip(0)).require_topology(mesh, "a", "b")


def test_broken_meshes_are_refused_with_what_was_found() -> None:
    mesh = grid()
    with pytest.raises(TopologyError, match="found indices 0 to 12, expected 0 to 11"):
        Mesh(mesh.vertices, torch.tensor([[0, 1, 12]]))
    with pytest.raises(ShapeError, match=r"found \(12, 2\), expected \(\*,3\)"):
        Mesh(mesh.vertices[:, :2], mesh.faces)
    broken = mesh.vertices.clone()
    broken[3, 1] = torch.nan
    with pytest.raises(ValueRangeError, match="1 of 12 vertices are NaN"):
        mesh.with_vertices(broken)
    with pytest.raises(TopologyError, match="not the fan triangulation"):
        Mesh(mesh.vertices, mesh.faces.flip(0), polygons=mesh.polygons)
    with pytest.raises(ValueRangeError, match="no vertex is kept"):
        submesh(mesh, torch.zeros(12, dtype=torch.bool))
