"""Unwrapping onto a cylinder, checked on surfaces whose unwrapped form is known."""

import math

import pytest
import torch
import trimesh

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.landmarks.scans.cylinder import CylinderLayout, fill_holes, unwrap
from torchface.landmarks.scans.scan_landmarks import curvature_image
from torchface.mesh import Mesh

SMALL = CylinderLayout(size=128, pitch=2.0, radius=90.0)


def still() -> Similarity:
    return Similarity(
        torch.ones(1, dtype=torch.float64), torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3).double()
    )


def ball(radius: float, groove: float = 0.0) -> Mesh:
    """A sphere round the origin, with a furrow along its equator if asked."""
    sphere = trimesh.creation.icosphere(subdivisions=6, radius=radius)
    vertices = torch.tensor(sphere.vertices)
    vertices = vertices * (1 - groove / radius * torch.exp(-0.5 * (vertices[:, 1:2] / 2.5) ** 2))
    return Mesh(
        vertices.float(), torch.tensor(sphere.faces, dtype=torch.int64), colors=(vertices / radius).float() / 2 + 0.5
    )


def test_pixels_and_points_are_inverse() -> None:
    layout = CylinderLayout()
    pixels = torch.rand(200, 2, dtype=torch.float64) * 1023
    radius = 60 + 60 * torch.rand(200, dtype=torch.float64)
    assert torch.allclose(layout.pixels(layout.points(pixels, radius)), pixels, atol=1e-9)


def test_a_square_on_the_cylinder_stays_a_square() -> None:
    layout = CylinderLayout()
    a, b, c = (layout.points(torch.tensor(p, dtype=torch.float64), torch.tensor(90.0).double()) for p in
               ([700.0, 300.0], [701.0, 300.0], [700.0, 301.0]))  # fmt: skip
    assert (a - b).norm() == pytest.approx(layout.pitch, rel=1e-4)
    assert (a - c).norm() == pytest.approx(layout.pitch, rel=1e-9)


def test_the_same_place_keeps_its_share_of_a_resized_picture() -> None:
    point = torch.tensor([30.0, 40.0, 80.0], dtype=torch.float64)
    large, small = CylinderLayout().pixels(point), CylinderLayout().resized(256).pixels(point)
    assert torch.allclose((large + 0.5) / 1024, (small + 0.5) / 256)


def test_a_sphere_unwraps_to_its_distance_from_the_axis() -> None:
    head = unwrap(ball(100.0), still(), SMALL)
    height = SMALL.points(SMALL.grid(), torch.ones(128, 128).double())[..., 1]
    inside = height.abs() < 80
    expected = (100.0**2 - height[inside] ** 2).sqrt()
    assert (head.radius[inside].double() - expected).abs().max() < 0.15
    assert not head.mask[height.abs() > 101].any()


def test_the_pose_is_applied_and_undone() -> None:
    mesh = ball(100.0)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.3, 0.2], [0.3, 0, -0.5], [-0.2, 0.5, 0]]).double())
    move = torch.tensor([10.0, -20.0, 30.0]).double()
    moved = mesh.with_vertices((1.1 * mesh.vertices.double() @ turn.T + move).float())
    pose = Similarity(torch.tensor([1.1]).double(), turn[None], move[None]).inverse()
    head = unwrap(moved, pose, SMALL)
    pixels = torch.tensor([[64.0, 64.0], [20.0, 50.0], [100.0, 90.0]])
    points, seen = head.surface_points(moved, pixels)
    assert seen.all()
    assert (SMALL.pixels(pose.apply(points[None].double())[0]) - pixels).abs().max() < 1e-3
    assert ((points.double() - move).norm(dim=-1) - 110).abs().max() < 0.2


def test_colours_follow_the_surface() -> None:
    head = unwrap(ball(100.0), still(), SMALL)
    place = SMALL.points(SMALL.grid(), head.radius.double())[head.mask] / 100 / 2 + 0.5
    assert (head.texture[:, head.mask].T.double() - place).abs().max() < 0.02


def test_relief_of_a_sphere_is_flat_and_its_furrow_dark() -> None:
    layout = CylinderLayout(size=256, pitch=1.0, radius=90.0)
    middle = slice(100, 156)
    smooth = curvature_image(unwrap(ball(90.0), still(), layout), contrast=8.0)[0, middle, middle]
    # The grey of curvature 1/R, near the equator where the picture's axes stand perpendicular.
    expected = 0.5 + 0.5 * math.tanh(8.0 / 90.0)
    assert (smooth - expected).abs().max() < 0.02
    furrowed = curvature_image(unwrap(ball(90.0, groove=3.0), still(), layout), contrast=8.0)[0]
    rows = furrowed[:, middle].mean(1)
    assert rows[127:129].mean() < 0.2
    assert rows[120:136].argmin() in (7, 8)


def test_what_cannot_be_unwrapped_is_refused() -> None:
    with pytest.raises(ValueRangeError, match="no surface round the axis"):
        unwrap(ball(100.0), Similarity(torch.ones(1), torch.eye(3)[None], torch.tensor([[0.0, 900.0, 0.0]])), SMALL)
    with pytest.raises(ShapeError, match="2 poses"):
        unwrap(ball(100.0), Similarity(torch.ones(2), torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3)), SMALL)
    with pytest.raises(ValueRangeError, match="more than once round"):
        CylinderLayout(size=1024, pitch=2.0)


def test_known_pixels_stay_and_holes_follow_what_is_around() -> None:
    x, y = torch.meshgrid(torch.arange(65.0), torch.arange(48.0), indexing="xy")
    image = torch.stack([0.01 * x, 0.5 + 0.002 * y])
    mask = torch.ones(48, 65, dtype=torch.bool)
    mask[10:22, 30:41] = False
    mask[:, 60:] = False
    filled = fill_holes(image * mask, mask)
    assert torch.equal(filled[:, mask], (image * mask)[:, mask])
    hole = torch.zeros_like(mask)
    hole[10:22, 30:41] = True
    assert (filled[:, hole] - image[:, hole]).abs().max() < 0.06
    low, high = image[0][mask].aminmax()
    assert filled[0].min() >= low - 1e-6
    assert filled[0].max() <= high + 1e-6


def test_one_known_pixel_fills_everything() -> None:
    mask = torch.zeros(17, 9, dtype=torch.bool)
    mask[3, 4] = True
    assert torch.allclose(fill_holes(mask.float()[None] * 0.7, mask), torch.full((1, 17, 9), 0.7))
