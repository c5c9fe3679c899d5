"""Rays hit what they should, as trimesh says too; a picture shows the mesh where the camera projects it."""

from pathlib import Path

import pytest
import torch
import trimesh

from torchface.errors import FileFormatError
from torchface.geometry.cameras.pinhole import look_at
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import Lighting, render, sample_texture
from torchface.rendering.compositing import heat_colors, save_rendered_image, sheet
from torchface.rendering.raycast import RayCaster


def sphere(radius: float = 50.0) -> Mesh:
    ball = trimesh.creation.icosphere(4, radius=radius)
    return Mesh(torch.from_numpy(ball.vertices.copy()).float(), torch.from_numpy(ball.faces.copy()).long())


def test_hits_agree_with_trimesh_far_from_the_origin() -> None:
    mesh = sphere()
    away = torch.tensor([4000.0, -2500, 9000])
    caster = RayCaster(mesh.vertices + away, mesh.faces)
    generator = torch.Generator().manual_seed(0)
    origins = torch.randn(500, 3, generator=generator) * 20 + torch.tensor([0, 0, 200.0])
    directions = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=generator) - torch.tensor([0, 0, 4.0]), dim=1
    )
    hits = caster.cast(origins + away, directions)
    seen = hits.triangle >= 0
    peer = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    points, rays, _ = trimesh.ray.ray_triangle.RayMeshIntersector(peer).intersects_location(
        origins.numpy(), directions.numpy(), multiple_hits=False
    )
    assert torch.equal(seen.nonzero()[:, 0], torch.from_numpy(rays).sort().values)
    found = (mesh.vertices[mesh.faces[hits.triangle[seen]]] * hits.barycentric[seen][..., None]).sum(1)
    order = rays.argsort()
    torch.testing.assert_close(found, torch.from_numpy(points[order]).float(), atol=2e-3, rtol=0)
    along = origins[seen] + hits.distance[seen, None] * directions[seen]
    torch.testing.assert_close(along.float(), found, atol=5e-3, rtol=0)
    assert torch.equal(caster.occluded(origins + away, directions), seen)


def test_picture_covers_the_projected_outline() -> None:
    mesh = sphere()
    camera = look_at(torch.zeros(3), yaw=30, pitch=10, span=150, width=120, height=150)
    picture = render(mesh, camera, lighting=Lighting(occlusion_rays=0), background=(0.0, 0.0, 1.0))
    covered = (picture[2] < 0.99).nonzero().flip(1).double()
    pixels = camera.project(mesh.vertices.double())
    assert (covered.amin(0) - pixels.amin(0)).abs().max() < 1.5
    assert (covered.amax(0) - pixels.amax(0)).abs().max() < 1.5


def test_camera_sees_right_as_right_and_up_as_up() -> None:
    camera = look_at(torch.zeros(3), yaw=0, span=100, width=101, height=101)
    points = torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]]).double()
    pixels = camera.project(points)
    torch.testing.assert_close(pixels[0], torch.tensor([50.0, 50]).double())
    assert pixels[1, 0] > 50
    assert pixels[2, 1] < 50
    torch.testing.assert_close(pixels[1, 0] - 50, torch.tensor(10.1, dtype=torch.float64), atol=1e-9, rtol=0)
    _, directions = camera.rays()
    toward = torch.nn.functional.normalize(points[1] - camera.centre, dim=0)
    column = int(pixels[1, 0].round())
    assert (directions[50, column] - toward).norm() < 0.004


def test_texture_is_sampled_with_its_first_row_on_top() -> None:
    texture = torch.zeros(3, 4, 4)
    texture[0, 0] = 1
    colors = sample_texture(texture, torch.tensor([[0.5, 0.99], [0.5, 0.01]]))
    torch.testing.assert_close(colors[:, 0], torch.tensor([1.0, 0.0]))


def test_pictures_of_other_kinds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"found the ending '.gif', expected .png, .jpg, .jpeg"):
        save_rendered_image(torch.zeros(3, 4, 4), tmp_path / "a.gif")
    assert not list(tmp_path.iterdir())


def test_sheet_keeps_every_picture_whole() -> None:
    pictures = [torch.full((3, 4 + i, 6 - i), i / 10) for i in range(3)]
    page = sheet(pictures, 2, gap=1)
    assert page.shape == (3, 5 + 1 + 6, 6 + 1 + 5)
    for i in range(3):
        assert int((page[0] == i / 10).sum()) == pictures[i][0].numel()
    colors = heat_colors(torch.tensor([0.0, 1.0, 5.0]), 1.0)
    assert torch.equal(colors[1], colors[2])
    assert not torch.equal(colors[0], colors[1])
