"""The scanner against the head that it scans: where the surface lies, what is torn, that files hold all of it."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

from planted.scan_files import write_scans
from torchface.errors import ValueRangeError
from torchface.geometry.meshes.operators import border_vertices, components, triangle_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.io import load_landmark_points, load_mesh
from torchface.landmarks import UV_LANDMARK_NAMES, load_annotations, uv_landmarks_from_ibug
from torchface.landmarks.scans.uv_landmark_names import LINES
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import sample_texture
from torchface.synthetic import performer
from torchface.synthetic.stages import RawScan, ScannerSettings, eyes_closed, scan_head, scanner
from torchface.synthetic.stages.depth_fusion import DepthNoise, fuse, surface_net
from torchface.synthetic.stages.scanner import Dress, Photography
from torchface.synthetic.stages.subdivision import catmull_clark, finely_coloured

COARSE = ScannerSettings(voxel=3.0, detail=3.0, photography=Photography(height=200))


@pytest.fixture(scope="module")
def closed() -> Mesh:
    return eyes_closed(performer())


@pytest.fixture(scope="module")
def scan(closed: Mesh) -> RawScan:
    return scan_head(closed, 3, COARSE)


def test_the_scan_lies_on_the_head(closed: Mesh) -> None:
    bare = replace(COARSE, dress=Dress(hair=0.0, collar=0.0), photography=None, noise=DepthNoise(0.1, grain=0.05))
    found = scan_head(closed, 3, bare)
    back = (found.mesh.vertices.double() - found.translation) @ found.rotation
    index = SurfaceIndex(closed.vertices, closed.faces)
    face = (back[:, 2] > 40) & (back[:, 1] > -110)
    distance = index.nearest(back[face]).distance
    assert distance.median() < 0.3
    assert distance.quantile(0.95) < 1.2


def test_the_scan_has_a_topology_of_its_own_and_is_torn(closed: Mesh, scan: RawScan) -> None:
    mesh = scan.mesh
    assert len(mesh.vertices) != len(closed.vertices)
    assert border_vertices(mesh.faces, len(mesh.vertices)).sum() > 100
    assert int(components(mesh.faces, len(mesh.vertices)).max()) <= scanner._CRUMBS + 1
    back = (mesh.vertices.double() - scan.translation) @ scan.rotation
    lowest = float(closed.vertices[closed.landmarks[8], 1]) - scanner._BELOW_CHIN
    assert back[:, 1].min() > lowest - 25
    hair = back[:, 1] > float(closed.vertices[:, 1].max()) + 2
    assert hair.any()


def test_normals_point_outward(scan: RawScan) -> None:
    back = (scan.mesh.vertices.double() - scan.translation) @ scan.rotation
    normals = triangle_normals(back, scan.mesh.faces)
    middle = back[scan.mesh.faces].mean(1)
    front = middle[:, 2] > 60
    assert (normals[front, 2] > 0).double().mean() > 0.95


def test_truth_belongs_to_the_head(closed: Mesh, scan: RawScan) -> None:
    twelve = uv_landmarks_from_ibug(closed.vertices[closed.landmarks].double())
    back = (scan.annotation.ordered() - scan.translation) @ scan.rotation
    skin = [i for i, name in enumerate(UV_LANDMARK_NAMES) if "cheek" not in name]
    assert (back[skin] - twelve[skin]).norm(dim=-1).max() < 1.0
    assert set(scan.annotation.lines) == set(LINES)
    for name, (left, right) in LINES.items():
        line = scan.annotation.lines[name]
        assert (line[0] - scan.annotation.points[left]).norm() < 1e-6
        assert (line[-1] - scan.annotation.points[right]).norm() < 1e-6
        distance = SurfaceIndex(scan.mesh.vertices, scan.mesh.faces).nearest(line).distance
        assert distance.median() < 3.0


def test_the_texture_shows_the_head(scan: RawScan) -> None:
    mesh = scan.mesh
    assert mesh.texture is not None
    assert mesh.uvs.min() >= 0
    assert mesh.uvs.max() <= 1

    corner = torch.zeros(len(mesh.vertices), 2)
    corner[mesh.faces.flatten()] = mesh.uvs[mesh.uv_faces.flatten()]
    colors = sample_texture(mesh.texture, corner)
    lip, cheek = scan.annotation.lines["lips"][30], scan.annotation.points["left_cheek"]
    lips, cheek = (colors[(mesh.vertices - at).norm(dim=-1).argsort()[:12]].mean(0) for at in (lip, cheek))
    assert lips[0] / lips[1] > 1.1 * cheek[0] / cheek[1]


def test_another_seed_gives_another_scan(closed: Mesh, scan: RawScan) -> None:
    other = scan_head(closed, 4, replace(COARSE, photography=None))
    assert len(other.mesh.vertices) != len(scan.mesh.vertices)


def test_files_hold_what_a_user_would_bring_the_same_from_the_same_seed(
    closed: Mesh, scan: RawScan, tmp_path: Path
) -> None:
    paths = write_scans([closed], tmp_path, COARSE, seed=3)
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".json", ".ljson", ".mtl", ".obj", ".png"]
    read = load_mesh(paths[0])
    assert (read.vertices - scan.mesh.vertices).abs().max() < 1e-3
    assert torch.equal(read.faces, scan.mesh.faces)
    assert read.texture is not None
    assert (load_landmark_points(paths[0].with_suffix(".ljson")).ibug() - scan.ibug).abs().max() < 1e-6
    truth = load_annotations(tmp_path / "annotations.json")[paths[0].name]
    assert torch.equal(truth.ordered(), scan.annotation.ordered())


def test_a_surface_net_finds_a_planted_sphere() -> None:
    size, radius = 24, 8.3
    grid = torch.cartesian_prod(*[torch.arange(size, dtype=torch.float64)] * 3) - 11.7
    shape = torch.tensor([size] * 3)
    vertices, faces = surface_net(torch.arange(size**3), grid.norm(dim=1) - radius, shape, torch.full((3,), -11.7), 1.0)
    assert (vertices.norm(dim=1) - radius).abs().max() < 0.1
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * torch.pi * radius**3, rel=0.02)


def test_fusion_leaves_a_hole_where_nobody_looks() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=50.0)
    mesh = Mesh(torch.tensor(ball.vertices).float(), torch.tensor(ball.faces, dtype=torch.int64))
    eyes = torch.tensor([[0.0, 0.0, 400.0]])
    vertices, _ = fuse(mesh, eyes, 3.0, DepthNoise(0.0, grain=0.0), torch.Generator().manual_seed(0))
    assert (vertices.norm(dim=1) - 50).abs().max() < 0.5
    assert vertices[:, 2].min() > 0
    assert vertices[:, 2].max() > 49.5


def test_subdivision_of_a_cube_is_catmull_and_clarks() -> None:
    box = trimesh.creation.box()
    quads = torch.tensor([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    corners = torch.tensor(box.vertices)
    values, faces, _ = catmull_clark(corners, quads)
    assert len(values) == 8 + 12 + 6
    assert len(faces) == 24
    # (F + 2R + (n-3)P)/n at a corner (1/2,1/2,1/2): F = 1/6, R = 1/3, n = 3.
    assert torch.allclose(values[:8], corners * (5 / 9))
    assert torch.allclose(values[8:20].norm(dim=1), torch.full((12,), (2 * 0.375**2) ** 0.5).double())


def test_the_smooth_surface_passes_through_the_heads_vertices(closed: Mesh) -> None:
    fine = finely_coloured(closed, 2.0)
    distance = (fine.vertices[: len(closed.vertices)] - closed.vertices).norm(dim=-1)
    assert distance.quantile(0.99) < 0.2
    assert len(fine.vertices) > 3 * len(closed.vertices)


def test_a_head_without_contacts_is_refused(closed: Mesh) -> None:
    bare = replace(closed, annotations=replace(closed.annotations, contacts=None))
    with pytest.raises(ValueRangeError, match="contact pairs"):
        scan_head(bare, 0, COARSE)
