"""On a ball the furthest point of a level curve is where the ball ends before the background."""

import math

import pytest
import torch

from torchface.errors import ShapeError
from torchface.geometry.cameras.sliding_contour import LevelCurves, level_curves, outermost
from torchface.geometry.rotations import rotation_matrix

RADIUS = 80.0


def ball() -> tuple[torch.Tensor, torch.Tensor]:
    """A fine ball of rings about the y axis."""
    rings, sectors = 60, 90
    theta = torch.linspace(0.05, math.pi - 0.05, rings, dtype=torch.float64)[:, None]
    phi = torch.arange(sectors, dtype=torch.float64) * 2 * math.pi / sectors
    points = torch.stack([theta.sin() * phi.sin(), theta.cos().expand(-1, sectors), theta.sin() * phi.cos()], dim=-1)
    row, column = torch.meshgrid(torch.arange(rings - 1), torch.arange(sectors), indexing="ij")
    a, b = row * sectors + column, row * sectors + (column + 1) % sectors
    c, d = a + sectors, b + sectors
    faces = torch.stack([torch.stack([a, c, b], -1), torch.stack([b, c, d], -1)], dim=2).reshape(-1, 3)
    return RADIUS * points.reshape(-1, 3), faces


def starts(vertices: torch.Tensor) -> torch.Tensor:
    """Left and right ends of the ball at three heights, and one point on the midline."""
    x = RADIUS * 0.9
    goals = torch.tensor([[s * x, y, -20.0] for y in (-30, 0, 25) for s in (-1, 1)] + [[0.0, -30.0, 74.0]])
    return torch.cdist(goals.double(), vertices).argmin(1)


@pytest.fixture(scope="module")
def curves() -> tuple[torch.Tensor, LevelCurves]:
    vertices, faces = ball()
    return vertices, level_curves(vertices, faces, starts(vertices))


def test_curves_keep_their_height_and_their_side(curves: tuple[torch.Tensor, LevelCurves]) -> None:
    vertices, found = curves
    points = found.interpolate(vertices)
    begin = vertices[starts(vertices)]
    torch.testing.assert_close(points[:, 0], begin)
    assert found.side.tolist() == [-1, 1, -1, 1, -1, 1, 0]
    assert found.valid.sum(1).tolist()[6] == 1  # a start on the midline does not slide
    assert int(found.valid.sum(1)[:6].min()) > 20
    off = (points[..., 1] - begin[:, None, 1])[found.valid]
    torch.testing.assert_close(off, torch.zeros_like(off), rtol=0, atol=1e-9)
    sideways = (points[..., 0] * found.side[:, None])[:6][found.valid[:6]]
    assert float(sideways.min()) > -2.0


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0])
def test_the_far_side_slides_to_the_edge_of_the_ball(degrees: float, curves: tuple[torch.Tensor, LevelCurves]) -> None:
    vertices, found = curves
    turn = rotation_matrix(torch.tensor([0.0, math.radians(degrees), 0.0], dtype=torch.float64))
    seen = (found.interpolate(vertices) @ turn.T)[..., :2]  # from infinitely far away
    outward = torch.stack([found.side, torch.zeros_like(found.side)], dim=-1).double()
    chosen = outermost(seen[None], found.valid, outward[None])[0]
    reached = seen[torch.arange(7), chosen, 0]
    heights = vertices[starts(vertices)][:, 1]
    edge = (RADIUS**2 - heights**2).sqrt()
    far = [1, 3, 5] if degrees else [0, 1, 2, 3, 4, 5]  # turned to the viewer's right, that side is far
    torch.testing.assert_close(reached[far].abs(), edge[far], rtol=0, atol=0.3)
    if degrees > 20:
        near = found.interpolate(vertices)[torch.arange(7), chosen][[0, 2, 4]]
        assert float((near - vertices[starts(vertices)][[0, 2, 4]]).norm(dim=-1).max()) < 6.0  # where they start
    assert int(chosen[6]) == 0


def test_other_values_travel_with_the_curves(curves: tuple[torch.Tensor, LevelCurves]) -> None:
    vertices, found = curves
    both = found.interpolate(torch.stack([vertices, 2 * vertices], dim=1))
    torch.testing.assert_close(both[:, :, 1], 2 * found.interpolate(vertices))


def test_wrong_shapes_are_named() -> None:
    vertices, faces = ball()
    with pytest.raises(ShapeError, match=r"starts \(2, 1\)"):
        level_curves(vertices, faces, torch.zeros(2, 1, dtype=torch.int64))
