"""Rasterised triangles beside rays through the same pixels."""

from __future__ import annotations

import torch

from torchface.geometry.cameras.pinhole import look_at
from torchface.rendering.rasterization import rasterize
from torchface.rendering.raycast import RayCaster
from torchface.synthetic import performer


def test_pixels_show_what_rays_hit() -> None:
    rig = performer()
    vertices, faces = rig.vertices.double(), rig.neutral.faces
    camera = look_at(vertices.mean(0), 35.0, 10.0, width=160, height=200)
    seen = vertices @ camera.rotation.T + camera.translation
    drawn = rasterize(camera.project(vertices), 1 / seen[:, 2], faces, 200, 160)
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
    assert len(rasterize(points, near, torch.tensor([[0, 1, 2]]), 10, 10).pixel) == 28
    assert len(rasterize(points, near, torch.tensor([[0, 2, 1], [0, 1, 3]]), 10, 10).pixel) == 0
