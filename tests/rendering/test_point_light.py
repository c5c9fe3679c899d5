"""Light on a surface is the product it is said to be, with gradients, and shadow where something stands between."""

import math

import pytest
import torch

from torchface.errors import ShapeError, ValueRangeError
from torchface.mesh import Mesh
from torchface.rendering.point_light import PointLight, irradiance, lit_by, vertex_albedo
from torchface.rendering.raycast import RayCaster

AMBIENT, INTENSITY = torch.tensor([0.1, 0.2, 0.3]), torch.tensor([1.0, 0.5, 0.25])


def test_a_surface_is_lit_by_the_cosine_and_by_everything_round_it() -> None:
    light = PointLight(AMBIENT, INTENSITY, torch.tensor([0.0, 0.0, 100.0]))
    points = torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [100, 0, 0]])
    tilt = math.sqrt(0.5)
    normals = torch.tensor([[0.0, 0, 1], [0, tilt, tilt], [0, 0, -1], [0, 0, 1]])
    expected = torch.tensor([1.0, tilt, 0.0, tilt])
    found = irradiance(points, normals, light)
    torch.testing.assert_close(found, AMBIENT + INTENSITY * expected[:, None])
    half = irradiance(points, normals, light, torch.full((4,), 0.5))
    torch.testing.assert_close(half, AMBIENT + INTENSITY * 0.5 * expected[:, None])


def test_gradients_are_those_of_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    points = 50 * torch.randn(6, 3, generator=generator, dtype=torch.float64)
    normals = torch.nn.functional.normalize(torch.randn(6, 3, generator=generator, dtype=torch.float64), dim=-1)

    def lit(points: torch.Tensor, normals: torch.Tensor, *parts: torch.Tensor) -> torch.Tensor:
        return irradiance(points, normals, PointLight(*parts))

    parts = [AMBIENT.double(), INTENSITY.double(), torch.tensor([200.0, -300.0, 400.0], dtype=torch.float64)]
    assert torch.autograd.gradcheck(lit, [x.requires_grad_() for x in (points, normals, *parts)])


def test_a_far_lamp_is_a_direction() -> None:
    light = PointLight.directional(AMBIENT, INTENSITY, torch.tensor([3.0, 0.0, -4.0]))
    points = torch.tensor([[0.0, 0, 500], [90, 50, 600], [-90, -50, 400]])
    torch.testing.assert_close(light.toward(points), torch.tensor([0.6, 0, -0.8]).expand(3, 3), atol=0.01, rtol=0)


def test_what_stands_between_throws_a_shadow() -> None:
    """A small square over a large one, a source above: the shadow is the small one's image, twice as large."""
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = torch.cat([100 * square, 10 * square + torch.tensor([0.0, 0, 50])])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    generator = torch.Generator().manual_seed(0)
    ground = torch.cat([200 * torch.rand(500, 2, generator=generator) - 100, torch.zeros(500, 1)], dim=1)
    up = torch.tensor([0.0, 0, 1]).expand(500, 3)
    lit = lit_by(torch.tensor([0.0, 0, 100]), RayCaster(vertices, faces), ground, up)
    away = ground[:, :2].abs().amax(1)
    assert not lit[away < 19.5].any()
    assert lit[away > 20.5].all()
    assert not lit_by(torch.tensor([0.0, 0, -100]), RayCaster(vertices, faces), ground, up).any()


def test_albedo_comes_from_colours_or_texture_and_its_lack_is_said() -> None:
    vertices, faces = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]])
    colors = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    torch.testing.assert_close(vertex_albedo(Mesh(vertices, faces, colors=colors)), colors)
    texture = torch.zeros(3, 2, 2)
    texture[0, 1, 0], texture[1, 1, 1], texture[2, 0, 0] = 1, 1, 1
    uvs = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75]])
    torch.testing.assert_close(vertex_albedo(Mesh(vertices, faces, uvs, faces, texture=texture)), colors)
    with pytest.raises(ValueRangeError, match="not from the video itself"):
        vertex_albedo(Mesh(vertices, faces))


def test_no_light_is_refused() -> None:
    with pytest.raises(ShapeError, match="intensity"):
        PointLight(AMBIENT, torch.ones(1), torch.zeros(3))
    with pytest.raises(ValueRangeError, match="ambient"):
        PointLight(-AMBIENT, INTENSITY, torch.zeros(3))
    with pytest.raises(ValueRangeError, match="position"):
        PointLight(AMBIENT, INTENSITY, torch.tensor([0.0, math.nan, 0]))
