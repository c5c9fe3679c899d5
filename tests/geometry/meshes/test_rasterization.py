"""Texels against points in triangles and areas; pixels of a picture beside the rays through them."""

import pytest
import torch
from scipy.spatial import Delaunay

from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.meshes.rasterization import TexelMap, rasterise, rasterise_uvs
from torchface.rendering.raycast import RayCaster
from torchface.synthetic import performer


def layout(count: int = 200, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    points = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    square = torch.tensor([[0.0, 0], [1, 0], [0, 1], [1, 1]], dtype=torch.float64)
    points = torch.cat([square, points])
    return points, torch.from_numpy(Delaunay(points.numpy()).simplices).long()


def test_a_triangulated_square_covers_every_texel_once_with_the_triangle_that_scipy_finds() -> None:
    uvs, faces = layout()
    found = rasterise_uvs(uvs, faces, 37, 64)
    assert torch.equal(found.texels, torch.arange(37 * 64))
    centres = torch.stack([(found.texels % 64 + 0.5) / 64, 1 - (found.texels // 64 + 0.5) / 37], dim=1).double()
    expected = torch.from_numpy(Delaunay(uvs.numpy()).find_simplex(centres.numpy())).long()
    assert torch.equal(found.triangles, expected)
    torch.testing.assert_close(found.interpolate(uvs, faces), centres)
    assert float(found.barycentric.min()) > -1e-6


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_every_winding_and_corner_order_fills_the_same_texels(turn: int) -> None:
    uvs, faces = layout(30, 1)
    first = rasterise_uvs(uvs, faces[:9], 50, 50)
    other = rasterise_uvs(uvs, faces[:9].roll(turn, 1).flip(1), 50, 50)
    assert torch.equal(first.triangles, other.triangles)
    torch.testing.assert_close(first.interpolate(uvs, faces), other.interpolate(uvs, faces.roll(turn, 1).flip(1)))


def test_share_of_texels_is_share_of_area() -> None:
    uvs = torch.tensor([[0.1, 0.2], [0.8, 0.3], [0.4, 0.9]])
    found = rasterise_uvs(uvs, torch.tensor([[0, 1, 2]]), 500, 800)
    assert found.mask().float().mean() == pytest.approx(0.23, rel=1e-3)
    rows, columns = found.mask().nonzero().double().mean(0).tolist()
    assert columns / 800 == pytest.approx(1.3 / 3, abs=2e-3)
    assert 1 - rows / 500 == pytest.approx(1.4 / 3, abs=2e-3)  # v grows upward, rows downward


def test_the_first_of_overlapping_triangles_has_the_texel_and_slivers_have_none() -> None:
    uvs = torch.tensor([[0.0, 0], [1, 0], [0, 1], [1, 1], [0.5, 0.5]])
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [0, 1, 3], [0, 4, 3], [4, 4, 4]])
    found = rasterise_uvs(uvs, faces, 64, 64)
    assert len(found.texels) == 64 * 64
    assert set(found.triangles.tolist()) == {0, 1}
    assert len(rasterise_uvs(uvs, faces[3:], 64, 64).texels) == 0


def test_what_lies_outside_the_square_is_cut_off() -> None:
    uvs = torch.tensor([[-5.0, -5.0], [9.0, -5.0], [-5.0, 9.0]])
    found = rasterise_uvs(uvs, torch.tensor([[0, 1, 2]]), 16, 16)
    assert len(found.texels) == 256
    assert len(rasterise_uvs(uvs + 20, torch.tensor([[0, 1, 2]]), 16, 16).texels) == 0
    assert len(rasterise_uvs(uvs, torch.zeros(0, 3, dtype=torch.int64), 16, 16).texels) == 0


def test_bad_layouts_are_refused() -> None:
    uvs, faces = layout(5)
    with pytest.raises(ValueRangeError, match="NaN"):
        rasterise_uvs(uvs * torch.nan, faces, 8, 8)
    with pytest.raises(ShapeError, match="0 x 8"):
        rasterise_uvs(uvs, faces, 0, 8)
    with pytest.raises(ShapeError, match="uvs"):
        rasterise_uvs(uvs[:, :1], faces, 8, 8)
    corner = torch.tensor([[0.0, 0], [1, 0], [0, 1]])
    with pytest.raises(TopologyError, match="times over"):
        rasterise_uvs(corner, torch.tensor([[0, 1, 2]]).repeat(10**5, 1), 1024, 1024)


def test_pixels_show_what_rays_hit() -> None:
    rig = performer()
    vertices, faces = rig.vertices.double(), rig.neutral.faces
    camera = look_at(vertices.mean(0), 35.0, 10.0, width=160, height=200)
    seen = vertices @ camera.rotation.T + camera.translation
    drawn = rasterise(camera.project(vertices), 1 / seen[:, 2], faces, 200, 160)
    origins, ways = (one.reshape(-1, 3) for one in camera.rays())
    hits = RayCaster(vertices, faces).cast(origins, ways)
    a, b, c = (vertices[faces[hits.triangle.clamp(min=0), k]] for k in range(3))
    front = (hits.triangle >= 0) & ((torch.linalg.cross(b - a, c - a) * ways).sum(1) < 0)
    covered = torch.full((160 * 200,), -1)
    covered[drawn.pixel] = drawn.triangle
    assert len(drawn.pixel.unique()) == len(drawn.pixel)
    assert float((covered[front] == hits.triangle[front]).float().mean()) > 0.995
    assert int((covered[hits.triangle < 0] >= 0).sum()) < 10
    depth = torch.full((160 * 200,), torch.nan, dtype=torch.float64)
    depth[drawn.pixel] = 1 / drawn.nearness.double()
    true = (hits.distance[:, None] * ways) @ camera.rotation.T
    both = front & (covered == hits.triangle)
    torch.testing.assert_close(depth[both], true[both, 2], atol=0.05, rtol=0)


def test_nothing_behind_and_nothing_broken_is_drawn() -> None:
    points = torch.tensor([[2.0, 2], [2, 8], [8, 2], [torch.nan, 3]])
    near = torch.ones(4)
    assert len(rasterise(points, near, torch.tensor([[0, 1, 2]]), 10, 10).pixel) == 28
    assert len(rasterise(points, near, torch.tensor([[0, 2, 1], [0, 1, 3]]), 10, 10).pixel) == 0


def test_an_image_has_a_margin_of_the_nearest_texel_before_its_background() -> None:
    texels = TexelMap(9, 9, torch.tensor([40, 44]), torch.zeros(2).long(), torch.zeros(2, 3))
    image = texels.image(torch.tensor([[1.0], [2.0]]), 2, torch.tensor([-1.0]))[0]
    assert [float(image[r, c]) for r, c in ((4, 4), (4, 8), (4, 2), (4, 1), (3, 7), (2, 4))] == [1, 2, 1, -1, 2, 1]
    assert float(texels.image(torch.tensor([[1.0], [2.0]]))[0, 0, 0]) == 1.5
