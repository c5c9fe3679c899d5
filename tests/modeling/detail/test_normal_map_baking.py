"""Normal maps: planted wrinkles come back, whatever pose the scan is in; what is no scan of the mesh is refused."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.rasterization import interpolate, rasterise_uvs
from torchface.geometry.meshes.tangent_space import from_tangent_space, tangent_space
from torchface.geometry.similarity import Similarity
from torchface.io import load_rig
from torchface.mesh import Mesh, submesh
from torchface.modeling import BakeSettings, NormalMap, align_scan, bake_normal_map, detail_maps

DEPTH, WIDTH = 0.3, 2.0
SIZE = 256


def radius(way: Tensor, depth: float) -> Tensor:
    """How far the head's surface is along unit directions (...,3); wrinkles are grooves across the forehead."""
    radii = torch.tensor([75.0, 115.0, 95.0], dtype=way.dtype)
    r = (way / radii).square().sum(-1).rsqrt()
    for centre, height, spread in (
        ((0.0, -0.1, 1.0), 22.0, 0.15),
        ((0.35, 0.12, 0.93), 6.0, 0.2),
        ((-0.35, 0.12, 0.93), 5.0, 0.2),
        ((0.0, -0.7, 0.7), 8.0, 0.25),
        ((0.95, 0.0, 0.1), 12.0, 0.12),
        ((-0.95, 0.05, 0.1), 12.0, 0.12),
    ):
        middle = torch.nn.functional.normalize(torch.tensor(centre, dtype=way.dtype), dim=0)
        r = r + height * torch.exp(-(way - middle).square().sum(-1) / spread**2)
    x, y = r * way[..., 0], r * way[..., 1]
    for level in (42.0, 50.0, 58.0, 66.0):
        across = (y - level - 2 * torch.sin(x / 12)).abs() / (WIDTH / 2)
        groove = torch.where(across < 1, torch.cos(math.pi / 2 * across.clamp(max=1)) ** 2, 0.0)
        r = r - depth * groove * torch.exp(-((x / 45) ** 4))
    return r


def height_above(points: Tensor, depth: float) -> Tensor:
    return points.norm(dim=-1) - radius(torch.nn.functional.normalize(points, dim=-1), depth)


def true_normals(points: Tensor, depth: float) -> Tensor:
    points = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(height_above(points, depth).sum(), points)
    return torch.nn.functional.normalize(gradient, dim=-1)


def patch(azimuth: tuple[float, float], latitude: tuple[float, float], columns: int, rows: int, depth: float) -> Mesh:
    """A grid over part of the head, degrees, with a texture that is unwrapped round the axis."""
    u, v = torch.linspace(0, 1, columns + 1).double(), torch.linspace(0, 1, rows + 1).double()
    v, u = (x.flatten() for x in torch.meshgrid(v, u, indexing="ij"))
    a = torch.deg2rad(azimuth[0] + u * (azimuth[1] - azimuth[0]))
    b = torch.deg2rad(latitude[0] + v * (latitude[1] - latitude[0]))
    way = torch.stack([b.cos() * a.sin(), b.sin(), b.cos() * a.cos()], dim=-1)
    grid = torch.arange(len(way)).view(rows + 1, columns + 1)
    quads = torch.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], dim=-1).reshape(-1, 4)
    points = way * radius(way, depth)[:, None]
    return Mesh.from_polygons(points, quads, torch.stack([u, v], 1) * 0.96 + 0.02, quads)


def head(columns: int = 60, rows: int = 48) -> Mesh:
    """The whole head, smooth and coarse, closed round the back by a seam of the texture."""
    open_head = patch((-180, 180), (-80, 80), columns, rows, 0.0)
    column = torch.arange(len(open_head.vertices)) % (columns + 1)
    joined = torch.arange(len(open_head.vertices)) - torch.where(column == columns, columns, 0)
    used, compact = joined[open_head.polygons].unique(return_inverse=True)
    return Mesh.from_polygons(open_head.vertices[used], compact, open_head.uvs, open_head.polygons)


@pytest.fixture(scope="module")
def face() -> Mesh:
    return head()


@pytest.fixture(scope="module")
def forehead() -> Mesh:
    return patch((-40, 40), (10, 55), 360, 280, DEPTH)


def still() -> Similarity:
    return Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))


def moved(mesh: Mesh, degrees: float, shift: tuple[float, float, float]) -> Mesh:
    axis = torch.nn.functional.normalize(torch.tensor([0.3, 1.0, -0.4], dtype=torch.float64), dim=0)
    generator = torch.linalg.cross(torch.eye(3).double(), axis.expand(3, 3))
    rotation = torch.linalg.matrix_exp(-generator * math.radians(degrees))
    return mesh.with_vertices(mesh.vertices @ rotation.T + torch.tensor(shift).double())


def error_degrees(mesh: Mesh, baked: NormalMap) -> tuple[Tensor, Tensor]:
    """At 20,000 texels: the angle between the normals that a renderer gets and the true ones, and between those and a
    head's without wrinkles; where wrinkles turn the normal by more than 8 degrees."""
    texels = rasterise_uvs(mesh.uvs, mesh.uv_faces, *baked.hit.shape)
    hit = baked.hit.flatten()[texels.texels].nonzero()[:, 0]
    some = hit[torch.randperm(len(hit), generator=torch.Generator().manual_seed(0))[:20000]]
    triangles, barycentric = texels.triangles[some], texels.barycentric[some]
    space = tangent_space(mesh.vertices, mesh.faces, mesh.uvs, mesh.uv_faces, vertex_normals(mesh.vertices, mesh.faces))
    frames = space.frames(triangles, barycentric)
    shown = from_tangent_space(frames, baked.normals.flatten(1)[:, texels.texels[some]].T.double())
    way = torch.nn.functional.normalize(frames[..., 2], dim=-1)
    points = (mesh.vertices[mesh.faces[triangles]] * barycentric[..., None]).sum(1)
    for _ in range(8):
        slope = (true_normals(points, DEPTH) * way).sum(-1, keepdim=True)
        points = points - height_above(points, DEPTH)[:, None] / slope * way
    truth = true_normals(points, DEPTH)
    relief = torch.rad2deg(torch.acos((truth * true_normals(points, 0.0)).sum(-1).clamp(-1, 1)))
    error = torch.rad2deg(torch.acos((truth * shown).sum(-1).clamp(-1, 1)))
    return error[relief > 8], relief[relief > 8]


def test_planted_wrinkles_come_back(face: Mesh, forehead: Mesh) -> None:
    baked = bake_normal_map(face, forehead, (768, 1536), alignment=still())
    error, relief = error_degrees(face, baked)
    assert len(error) > 1000
    assert relief.median() > 12
    assert error.median() < 3


def test_a_scan_in_another_pose_is_laid_on_the_mesh_by_picked_points(face: Mesh, forehead: Mesh) -> None:
    ids = face.vertices[:, 2].topk(400).indices[::40]
    truth = moved(face, 140, (300.0, -40, 900))
    noise = torch.randn(len(ids), 3, generator=torch.Generator().manual_seed(1)).double()  # a hand's accuracy
    scan = moved(forehead, 140, (300.0, -40, 900))
    found = align_scan(face, scan, (ids, truth.vertices[ids] + noise))
    brow = (face.vertices[:, 1] > 20) & (face.vertices[:, 2] > 40)
    assert (found.similarity.apply(truth.vertices[brow][None])[0] - face.vertices[brow]).norm(dim=1).max() < 1.0
    picked = truth.vertices[ids] + noise  # on a whole face, to which the nearest points are found sooner
    by_ids, by_points = (align_scan(face, truth, (on_mesh, picked)) for on_mesh in (ids, face.vertices[ids]))
    assert torch.equal(by_points.similarity.rotation, by_ids.similarity.rotation)


@pytest.mark.bench  # test_scan_alignment.py finds the pose without picks, and other tests here bake
def test_wrinkles_come_back_from_a_scan_in_another_pose_without_picks(face: Mesh) -> None:
    scan = moved(patch((-60, 60), (-30, 60), 480, 440, DEPTH), 100, (30.0, 200, -100))
    baked = bake_normal_map(face, scan, (768, 1536))
    error, relief = error_degrees(face, baked)
    assert relief.median() > 12
    assert error.median() < 5


def test_a_mesh_baked_on_itself_is_flat_everywhere(face: Mesh) -> None:
    baked = bake_normal_map(face, face, SIZE, alignment=still())
    assert baked.statistics.hit_share == 1.0
    assert baked.statistics.far_distance < 1e-3
    assert (baked.normals - torch.tensor([0.0, 0, 1])[:, None, None]).abs().max() < 2e-3


def test_a_scan_in_another_scale_is_fitted_when_asked(face: Mesh) -> None:
    scan = patch((-150, 150), (-70, 70), 90, 60, 0.0)
    scan = scan.with_vertices(scan.vertices * 1.04)
    baked = bake_normal_map(face, scan, 64, scale=True)
    assert float(baked.alignment.similarity.scale) == pytest.approx(1 / 1.04, rel=2e-3)


def test_hits_too_far_or_from_inside_leave_the_map_flat(face: Mesh, forehead: Mesh) -> None:
    away = forehead.with_vertices(forehead.vertices * 1.1)
    baked = bake_normal_map(face, away, SIZE, alignment=still(), settings=BakeSettings(maximum_distance=2.0))
    assert baked.statistics.hit_share == 0
    assert torch.equal(baked.normals[2], torch.ones(SIZE, SIZE))
    near = bake_normal_map(face, forehead, SIZE, alignment=still())
    assert 0 < near.statistics.hit_share < 0.2
    assert (
        near.normals[:2].abs().sum(0)[~near.hit].count_nonzero()
    ) < 20 * SIZE  # only what dilation wrote at the seams


def test_offset_tells_on_which_side_the_scan_lies(face: Mesh) -> None:
    outside = face.with_vertices(face.vertices + 1.5 * vertex_normals(face.vertices, face.faces))
    baked = bake_normal_map(face, outside, 256, alignment=still())
    assert baked.statistics.median_offset == pytest.approx(1.5, abs=0.02)
    assert (baked.heights[baked.hit] - 1.5).abs().max() < 0.2
    assert (baked.heights[baked.hit] - 1.5).abs().mean() < 0.02
    inside = face.with_vertices(face.vertices - 1.5 * vertex_normals(face.vertices, face.faces))
    assert bake_normal_map(face, inside, 256, alignment=still()).statistics.median_offset == pytest.approx(
        -1.5, abs=0.02
    )


def test_a_turned_texture_turns_the_map_but_not_the_normals_it_stands_for(forehead: Mesh) -> None:
    face = patch((-60, 60), (0, 65), 20, 20, 0.0)
    for uvs in (face.uvs.flip(1), torch.stack([1 - face.uvs[:, 0], face.uvs[:, 1]], 1)):  # mirrored, both
        turned = replace(face, uvs=uvs)
        baked = bake_normal_map(turned, forehead, 384, alignment=still())
        assert error_degrees(turned, baked)[0].median() < 3


@pytest.mark.bench
@pytest.mark.real
def test_wrinkles_planted_on_a_real_head_come_back_across_its_texture(ict_folder: Path) -> None:
    neutral = load_rig(ict_folder, part="face").neutral
    mesh = neutral.with_vertices(neutral.vertices.double())
    smooth = vertex_normals(mesh.vertices, mesh.faces)
    brow = mesh.vertices[mesh.landmarks[17:27]].mean(0)

    def relief(points: Tensor) -> Tensor:
        x, y, _ = (points - brow).unbind(-1)
        folds = torch.stack([y - level - 3 * torch.sin(x / 14) for level in (18.0, 26, 34)]) / (WIDTH / 2)
        depth = torch.where(folds.abs() < 1, torch.cos(math.pi / 2 * folds.clamp(-1, 1)) ** 2, 0.0).sum(0)
        return -DEPTH * depth * torch.exp(-((x / 38) ** 4))

    offset = mesh.vertices - brow
    part = submesh(mesh, (offset[:, 1] > 0) & (offset[:, 1] < 50) & (offset[:, 2] > -50))
    points, faces = part.mesh.vertices.numpy(), part.mesh.faces.numpy()
    attributes = {"normal": smooth[part.vertex_ids].numpy()}
    for _ in range(3):
        points, faces, attributes = trimesh.remesh.subdivide(points, faces, vertex_attributes=attributes)
    dense = torch.from_numpy(points)
    ways = torch.nn.functional.normalize(torch.from_numpy(attributes["normal"]), dim=1)
    scan = Mesh(dense + relief(dense)[:, None] * ways, torch.from_numpy(faces).long())
    baked = bake_normal_map(mesh, scan, 1536, alignment=still())

    texels = rasterise_uvs(mesh.uvs, mesh.uv_faces, 1536, 1536)
    hit = baked.hit.flatten()[texels.texels].nonzero()[::11, 0]
    triangles, barycentric = texels.triangles[hit], texels.barycentric[hit]
    frames = tangent_space(mesh.vertices, mesh.faces, mesh.uvs.double(), mesh.uv_faces, smooth).frames(
        triangles, barycentric
    )
    way = torch.nn.functional.normalize(frames[..., 2], dim=-1)
    at = interpolate(mesh.vertices, mesh.faces[triangles], barycentric).requires_grad_()
    (slope,) = torch.autograd.grad(relief(at).sum(), at)
    truth = torch.nn.functional.normalize(way - slope + way * (slope * way).sum(-1, keepdim=True), dim=-1)
    shown = from_tangent_space(frames, baked.normals.flatten(1)[:, texels.texels[hit]].T.double())
    turn = torch.rad2deg(torch.acos((truth * way).sum(-1).clamp(-1, 1)))
    error = torch.rad2deg(torch.acos((truth * shown).sum(-1).clamp(-1, 1)))[turn > 8]
    assert len(error) > 500
    assert turn[turn > 8].median() > 12
    assert error.median() < 5


def test_shapes_keep_the_neutrals_skin_where_their_scan_told_nothing(face: Mesh, forehead: Mesh) -> None:
    whole = patch((-179, 179), (-79, 79), 300, 200, 0.0)
    neutral = bake_normal_map(face, whole, SIZE, alignment=still())
    frown = bake_normal_map(face, forehead, SIZE, alignment=still())
    maps = detail_maps(["browDownLeft"], [frown], neutral)
    assert torch.equal(maps.maps[0][:, frown.hit], frown.normals[:, frown.hit])
    assert torch.equal(maps.maps[0][:, ~frown.hit], neutral.normals[:, ~frown.hit])


def mesh_without_uvs(face: Mesh) -> Mesh:
    return replace(face, uvs=None, uv_faces=None)


@pytest.mark.parametrize("size", [0, -5, 10**6, (512, 0), (512, 512, 3), 512.0])
def test_absurd_sizes_are_refused(face: Mesh, size: object) -> None:
    with pytest.raises(ValueRangeError, match="size"):
        bake_normal_map(face, face, size)


def test_bad_meshes_are_refused(face: Mesh) -> None:
    with pytest.raises(TopologyError, match="texture coordinates"):
        bake_normal_map(mesh_without_uvs(face), face, 64)
    empty = Mesh(face.vertices, face.faces[:0])
    with pytest.raises(TopologyError, match="no triangle"):
        bake_normal_map(face, empty, 64)
    collapsed = face.with_vertices(face.vertices * 0)
    with pytest.raises(TopologyError, match="without area"):
        bake_normal_map(face, collapsed, 64)
    with pytest.raises(ValueRangeError, match="uvs"):
        bake_normal_map(replace(face, uvs=face.uvs * torch.nan), face, 64, alignment=still())
    with pytest.raises(ValueRangeError, match="unit square"):
        bake_normal_map(replace(face, uvs=face.uvs + 3), face, 64, alignment=still())
    inside_out = Mesh(face.vertices, face.faces.flip(1))
    with pytest.raises(ValueRangeError, match="counter-clockwise"):
        bake_normal_map(face, inside_out, 64, alignment=still())


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "metres"), (0.1, "centimetres")])
def test_a_scan_in_another_unit_is_named(face: Mesh, factor: float, unit: str) -> None:
    small = face.with_vertices(face.vertices * factor)
    with pytest.raises(ValueRangeError, match=f"were in {unit}"):
        bake_normal_map(face, small, 64)


def test_bad_correspondences_are_refused(face: Mesh) -> None:
    ids = torch.tensor([3, 900, 2000])
    points = face.vertices[ids]
    with pytest.raises(ShapeError, match="at least 3"):
        bake_normal_map(face, face, 64, (ids[:2], points[:2]))
    with pytest.raises(ShapeError, match="points"):
        bake_normal_map(face, face, 64, (ids, points[:, :2]))
    with pytest.raises(ValueRangeError, match="NaN"):
        bake_normal_map(face, face, 64, (ids, points * torch.nan))
    with pytest.raises(ValueRangeError, match="line"):
        bake_normal_map(face, face, 64, (ids, torch.outer(torch.arange(3.0).double(), points[0])))
    with pytest.raises(ValueRangeError, match="vertices"):
        bake_normal_map(face, face, 64, (ids + 10**6, points))
    with pytest.raises(ValueRangeError, match="one of them"):
        bake_normal_map(face, face, 64, (ids, points), alignment=still())


def test_a_scan_of_something_else_is_refused(face: Mesh) -> None:
    plane = Mesh(torch.tensor([[0.0, 0, 0], [200, 0, 0], [0, 200, 0]]).double(), torch.tensor([[0, 1, 2]]))
    with pytest.raises(AlignmentError, match="correspondences"):
        bake_normal_map(face, plane, 64)
