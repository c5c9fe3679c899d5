"""A coarse mesh with a normal map looks like the fine surface that the map stands for."""

import math

import pytest
import torch

from torchface.errors import ShapeError, TopologyError
from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.meshes.normal_maps import flat_normal_map
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import Lighting, render

BARE = Lighting(occlusion_rays=0)


def wavy_sheet(cells: int, mirrored: bool = False, turned: bool = False) -> tuple[Mesh, torch.Tensor]:
    """A sheet of 100 mm with waves 0.4 mm high, and the map (3,512,512) that gives a flat one its look."""
    line = torch.linspace(0, 1, cells + 1).double()
    v, u = (x.flatten() for x in torch.meshgrid(line, line, indexing="ij"))
    grid = torch.arange(len(u)).view(cells + 1, cells + 1)
    quads = torch.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], dim=-1).reshape(-1, 4)
    height = 0.4 * torch.sin(8 * math.pi * u) * torch.cos(6 * math.pi * v)
    x, y = 100 * u - 50, 100 * v - 50
    s, t = (1 - u if mirrored else u), v
    if turned:
        s, t = t, 1 - s
    mesh = Mesh.from_polygons(torch.stack([x, y, height], 1), quads, torch.stack([s, t], 1), quads)
    centre = (torch.arange(512).double() + 0.5) / 512
    t, s = torch.meshgrid(1 - centre, centre, indexing="ij")
    if turned:
        s, t = 1 - t, s
    u, v = (1 - s if mirrored else s), t
    across = 0.4 * 8 * math.pi / 100 * torch.cos(8 * math.pi * u) * torch.cos(6 * math.pi * v)
    up = -0.4 * 6 * math.pi / 100 * torch.sin(8 * math.pi * u) * torch.sin(6 * math.pi * v)
    along_s = -across if mirrored else across
    slopes = (up, -along_s) if turned else (along_s, up)
    normals = torch.stack([-slopes[0], -slopes[1], torch.ones_like(up)])
    return mesh, torch.nn.functional.normalize(normals, dim=0).float()


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("yaw", [40.0, pytest.param(0.0, marks=pytest.mark.bench)])
def test_a_flat_sheet_with_a_map_is_shaded_like_the_waves(mirrored: bool, turned: bool, yaw: float) -> None:
    waves, normal_map = wavy_sheet(200, mirrored, turned)
    flat = waves.with_vertices(waves.vertices * torch.tensor([1.0, 1, 0]).double())
    camera = look_at(torch.zeros(3), yaw, span=70, width=96, height=96)
    truth = render(waves, camera, lighting=BARE)
    plain = (render(flat, camera, lighting=BARE) - truth).abs().mean()
    mapped = (render(flat, camera, lighting=BARE, normal_map=normal_map) - truth).abs().mean()
    assert mapped < 0.12 * plain


def test_a_flat_map_changes_nothing() -> None:
    waves, _ = wavy_sheet(20)
    camera = look_at(torch.zeros(3), 20, span=120, width=48, height=48)
    mapped = render(waves, camera, normal_map=flat_normal_map(8, 8))
    torch.testing.assert_close(mapped, render(waves, camera), atol=1e-5, rtol=0)


def test_a_map_needs_texture_coordinates_and_three_channels() -> None:
    waves, normal_map = wavy_sheet(4)
    camera = look_at(torch.zeros(3), 0, span=120, width=16, height=16)
    with pytest.raises(ShapeError, match="normal_map"):
        render(waves, camera, normal_map=normal_map[:2])
    with pytest.raises(TopologyError, match="texture coordinates"):
        render(Mesh(waves.vertices, waves.faces), camera, normal_map=normal_map)
