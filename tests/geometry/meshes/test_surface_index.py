"""Nearest points on triangle meshes."""

import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.meshes.operators import border_vertices
from torchface.geometry.meshes.surface_index import SurfaceIndex

SQUARE = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 0]])
FAN = torch.tensor([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])


def soup(seed: int, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Triangles of sizes from 0.01 to 100, slivers, segments and points among them."""
    generator = np.random.default_rng(seed)
    size = 10.0 ** generator.uniform(-2, 2, (count, 1, 1))
    corners = generator.normal(size=(count, 1, 3)) * 50 + generator.normal(size=(count, 3, 3)) * size
    corners[::7, 2] = corners[::7, 0] + 0.3 * (corners[::7, 1] - corners[::7, 0])
    corners[::11] = corners[::11, :1]
    return torch.from_numpy(corners.reshape(-1, 3)), torch.arange(3 * count).reshape(-1, 3)


def segment_distance(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    t = ((p - a) * (b - a)).sum(-1) / np.maximum(((b - a) ** 2).sum(-1), 1e-300)
    return np.linalg.norm(p - a - np.clip(t, 0, 1)[..., None] * (b - a), axis=-1)


def brute_force(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distance of each point to the nearest of all triangles: to the plane where its foot is inside, else the edges."""
    p = points[:, None]
    a, b, c = triangles[None, :, 0], triangles[None, :, 1], triangles[None, :, 2]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=-1)
    unit = normal / np.maximum(length, 1e-300)[..., None]
    height = ((p - a) * unit).sum(-1)
    foot = p - height[..., None] * unit
    inside = length > 1e-12
    for x, y in ((a, b), (b, c), (c, a)):
        inside = inside & ((np.cross(y - x, foot - x) * unit).sum(-1) >= 0)
    edges = np.minimum(np.minimum(segment_distance(p, a, b), segment_distance(p, b, c)), segment_distance(p, c, a))
    return np.where(inside, np.minimum(np.abs(height), edges), edges).min(1)


@pytest.mark.parametrize("away", [0.0, 0.5, 20.0])
def test_nearest_point_agrees_with_trimesh(away: float) -> None:
    ball = trimesh.creation.icosphere(3, 50.0)
    ball.vertices *= [1.0, 1.3, 0.8]
    generator = np.random.default_rng(0)
    queries = ball.vertices * 1.001 + generator.normal(0, 1e-3 + away, ball.vertices.shape)
    points, distance, _ = trimesh.proximity.closest_point(ball, queries)
    found = SurfaceIndex(torch.tensor(ball.vertices), torch.tensor(ball.faces)).nearest(torch.tensor(queries))
    assert np.allclose(found.distance.numpy(), distance, atol=1e-8)
    assert np.allclose(found.points.numpy(), points, atol=1e-4)


@given(st.integers(0, 10_000), st.integers(1, 60))
def test_nearest_point_of_a_triangle_soup_agrees_with_trying_all(seed: int, count: int) -> None:
    vertices, faces = soup(seed, count)
    queries = torch.from_numpy(np.random.default_rng(seed + 1).normal(size=(20, 3)) * 80)
    found = SurfaceIndex(vertices, faces).nearest(queries)
    expected = brute_force(queries.numpy(), vertices[faces].numpy())
    assert np.allclose(found.distance.numpy(), expected, rtol=1e-7, atol=1e-7)


def test_points_barycentrics_and_distances_tell_the_same() -> None:
    vertices, faces = soup(3, 200)
    queries = torch.randn(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 60
    found = SurfaceIndex(vertices, faces).nearest(queries)
    blended = (vertices[faces[found.triangle]] * found.barycentric[..., None]).sum(1)
    assert torch.allclose(blended, found.points, atol=1e-9)
    assert torch.allclose((queries - found.points).norm(dim=1), found.distance)
    assert bool((found.barycentric >= -1e-12).all())
    assert torch.allclose(found.barycentric.sum(1), torch.ones(500, dtype=torch.float64))


def test_quick_search_is_never_nearer_and_seldom_further() -> None:
    ball = trimesh.creation.icosphere(4, 50.0)
    index = SurfaceIndex(torch.tensor(ball.vertices), torch.tensor(ball.faces))
    generator = torch.Generator().manual_seed(0)
    queries = torch.tensor(ball.vertices) + torch.randn(len(ball.vertices), 3, generator=generator, dtype=torch.float64)
    exact, quick = index.nearest(queries), index.among_nearest_samples(queries)
    assert float((quick.distance - exact.distance).min()) > -1e-12
    excess = quick.distance - exact.distance
    assert float((excess > 1e-9).double().mean()) < 0.05
    assert float(excess.mean()) < 1e-3 * float(ball.edges_unique_length.mean())


def test_normals_and_border_of_a_square() -> None:
    index = SurfaceIndex(SQUARE, FAN)
    found = index.nearest(torch.tensor([[1.0, 0.5, 3.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 1.0], [1.0, 1.0, 1.0]]))
    assert index.on_border(found).tolist() == [False, True, True, False]
    assert torch.allclose(index.normals_at(found), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(4, 3))


def test_a_closed_surface_has_no_border() -> None:
    ball = trimesh.creation.icosphere(2, 50.0)
    index = SurfaceIndex(torch.tensor(ball.vertices), torch.tensor(ball.faces))
    corners_and_beyond = torch.cat([torch.tensor(ball.vertices), torch.tensor(ball.vertices) * 1.2])
    assert not index.on_border(index.nearest(corners_and_beyond)).any()
    assert not border_vertices(index.faces, len(index.vertices)).any()


def test_bad_input_is_refused() -> None:
    with pytest.raises(ShapeError, match="at least one"):
        SurfaceIndex(SQUARE, FAN[:0])
    index = SurfaceIndex(SQUARE, FAN)
    with pytest.raises(ValueRangeError, match="NaN"):
        index.nearest(torch.tensor([[math.nan, 0.0, 0.0]]))
    with pytest.raises(ShapeError, match="expected \\(Q,3\\)"):
        index.nearest(torch.zeros(3))
    assert len(index.nearest(torch.zeros(0, 3)).distance) == 0
