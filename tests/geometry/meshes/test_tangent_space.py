"""Tangent frames: where the texture grows, whatever its orientation, and there and back."""

import torch

from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.tangent_space import from_tangent_space, tangent_space, to_tangent_space


def cylinder(mirrored: bool = False) -> tuple[torch.Tensor, ...]:
    """An open cylinder about y, unwrapped once round from a seam at the back, or twice half round."""
    columns, rows = 24, 6
    angle = torch.arange(columns + 1).double() / columns * 2 * torch.pi
    height = torch.arange(rows + 1).double() * 5
    y, a = torch.meshgrid(height, angle, indexing="ij")
    u, v = a.flatten() / (2 * torch.pi), y.flatten() / 30
    if mirrored:
        u = (u - 0.5).abs()
    grid = torch.arange((rows + 1) * (columns + 1)).view(rows + 1, columns + 1)
    quads = torch.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], dim=-1).reshape(-1, 4)
    uv_faces = torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    faces = uv_faces - torch.where(uv_faces % (columns + 1) == columns, columns, 0)
    points = torch.stack([-40 * a.sin(), y, -40 * a.cos()], dim=-1).reshape(-1, 3)
    return points, faces, torch.stack([u, v], dim=1), uv_faces


def test_on_a_cylinder_the_tangent_runs_round_it_and_the_bitangent_up_across_the_seam_too() -> None:
    points, faces, uvs, uv_faces = cylinder()
    normals = vertex_normals(points, faces)
    space = tangent_space(points, faces, uvs, uv_faces, normals)
    triangles = torch.arange(len(faces))
    for barycentric in ([1.0, 0, 0], [0, 1.0, 0], [1 / 3, 1 / 3, 1 / 3]):
        frames = space.frames(triangles, torch.tensor([barycentric]).expand(len(faces), 3))
        frames = torch.nn.functional.normalize(frames, dim=1)
        up = torch.tensor([0.0, 1, 0]).double().expand(len(faces), 3)
        torch.testing.assert_close(frames[..., 1], up, atol=1e-3, rtol=0)
        torch.testing.assert_close(frames[..., 0], torch.linalg.cross(up, frames[..., 2]), atol=1e-3, rtol=0)
    assert bool((space.signs == 1).all())


def test_a_mirrored_half_has_the_other_sign_and_splits_the_vertices_between() -> None:
    points, faces, uvs, uv_faces = cylinder(mirrored=True)
    space = tangent_space(points, faces, uvs, uv_faces, vertex_normals(points, faces))
    signs = space.signs[space.tangent_faces]
    assert bool((signs == signs[:, :1]).all())  # a triangle lies in one half
    assert int((signs[:, 0] < 0).sum()) == int((signs[:, 0] > 0).sum())
    frames = space.frames(torch.arange(len(faces)), torch.full((len(faces), 3), 1 / 3))
    assert float(torch.nn.functional.normalize(frames[..., 1], dim=-1)[:, 1].min()) > 0.99  # v grows up in both


def test_tangents_are_unit_and_perpendicular_and_follow_a_turn_of_the_mesh() -> None:
    points, faces, uvs, uv_faces = cylinder()
    generator = torch.Generator().manual_seed(0)
    points = points + torch.randn(points.shape, generator=generator).double()
    uvs = uvs + 0.01 * torch.randn(uvs.shape, generator=generator).double()
    normals = vertex_normals(points, faces)
    space = tangent_space(points, faces, uvs, uv_faces, normals)
    torch.testing.assert_close(space.tangents.norm(dim=1), torch.ones(len(space.tangents)).double())
    rows = torch.zeros(len(space.tangents), dtype=torch.int64)
    rows[space.tangent_faces] = faces
    assert float((space.tangents * normals[rows]).sum(1).abs().max()) < 1e-12
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, 1, 2], [-1, 0, 0.5], [-2, -0.5, 0]]).double())
    turned = tangent_space(points @ turn.T, faces, uvs, uv_faces, normals @ turn.T)
    torch.testing.assert_close(turned.tangents, space.tangents @ turn.T)


def test_a_shared_corner_takes_the_mean_of_its_triangles_weighted_by_angle() -> None:
    # At the origin an angle of 90 degrees, where u grows along x, meets one of 45, where it grows along x - y/2.
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 1, 0]]).double()
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uvs = torch.tensor([[0.0, 0], [1, 0], [0, 1], [-1, 0.5]]).double()
    normals = torch.tensor([[0.0, 0, 1]]).double().expand(4, 3)
    space = tangent_space(points, faces, uvs, faces, normals)
    first, second = torch.tensor([[1.0, 0, 0], [1.0, -0.5, 0]]).double()
    expected = torch.nn.functional.normalize(2 * first + second / second.norm(), dim=0)
    torch.testing.assert_close(space.tangents[space.tangent_faces[0, 0]], expected)
    torch.testing.assert_close(space.tangents[space.tangent_faces[1, 2]], second / second.norm())


def test_there_and_back() -> None:
    generator = torch.Generator().manual_seed(1)
    frames = torch.randn(500, 3, 3, generator=generator).double()
    ways = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator).double(), dim=1)
    torch.testing.assert_close(from_tangent_space(frames, to_tangent_space(frames, ways)), ways)
    collapsed = torch.zeros(1, 3, 3).double()
    assert to_tangent_space(collapsed, ways[:1]).abs().max() == 0


def test_a_texture_without_extent_still_gives_frames() -> None:
    points, faces, uvs, uv_faces = cylinder()
    space = tangent_space(points, faces, uvs * 0, uv_faces, vertex_normals(points, faces))
    torch.testing.assert_close(space.tangents.norm(dim=1), torch.ones(len(space.tangents)).double())
