"""Deformation gradients and the operator that reads them: affine maps come back, the fourth vertex does its part."""

import numpy as np
import torch
from scipy.spatial import Delaunay

from torchface.geometry.meshes.deformation import (
    deformation_gradients,
    degenerate_triangles,
    gradient_operator,
    triangle_frames,
)
from torchface.geometry.meshes.operators import triangle_normals


def bumpy_sheet(seed: int = 0, count: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-10, 10, (count, 2))
    height = 2 * np.sin(flat[:, :1] / 3) + rng.normal(0, 0.3, (count, 1))
    return torch.from_numpy(np.concatenate([flat, height], 1)), torch.from_numpy(Delaunay(flat).simplices).long()


def random_rotation(seed: int) -> torch.Tensor:
    q, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))
    return q * torch.det(q).sign()


def test_a_similarity_is_every_triangles_gradient() -> None:
    vertices, faces = bumpy_sheet()
    linear = 1.7 * random_rotation(3)
    gradients = deformation_gradients(vertices, vertices @ linear.T + 5.0, faces)
    torch.testing.assert_close(gradients, linear.expand(len(faces), 3, 3), atol=1e-9, rtol=0)


def test_an_affine_map_is_every_gradient_within_the_triangles_plane() -> None:
    vertices, faces = bumpy_sheet(1)
    linear = torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    gradients = deformation_gradients(vertices, vertices @ linear.T, faces)
    edges = triangle_frames(vertices, faces)[..., :2]
    torch.testing.assert_close(gradients @ edges, linear @ edges, atol=1e-9, rtol=0)


def test_the_fourth_vertex_grows_with_the_square_root_of_the_area() -> None:
    vertices, faces = bumpy_sheet(2)
    stretched = vertices * torch.tensor([3.0, 3.0, 3.0], dtype=torch.float64)
    fourth = triangle_frames(vertices, faces)[..., 2]
    torch.testing.assert_close(triangle_frames(stretched, faces)[..., 2], 3 * fourth)
    torch.testing.assert_close(torch.nn.functional.normalize(fourth, dim=-1), triangle_normals(vertices, faces))


def test_gradients_are_batched_over_poses() -> None:
    vertices, faces = bumpy_sheet(3)
    poses = vertices + torch.randn(4, *vertices.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    together = deformation_gradients(vertices, poses, faces)
    torch.testing.assert_close(together[2], deformation_gradients(vertices, poses[2], faces))


def test_triangles_without_area_give_finite_gradients() -> None:
    vertices, faces = bumpy_sheet(4)
    collapsed = vertices.clone()
    a, b, c = faces[0].tolist()
    collapsed[c] = 0.5 * (collapsed[a] + collapsed[b])
    assert degenerate_triangles(collapsed, faces)[0]
    assert not degenerate_triangles(vertices, faces).any()
    lost = deformation_gradients(vertices, collapsed, faces)[0]
    torch.testing.assert_close(
        lost @ triangle_frames(vertices, faces)[0, :, :2], triangle_frames(collapsed, faces)[0, :, :2]
    )
    assert torch.linalg.matrix_rank(lost, atol=1e-6) == 1
    from_nothing = deformation_gradients(collapsed, vertices, faces)
    torch.testing.assert_close(from_nothing[0], torch.eye(3, dtype=torch.float64))
    assert torch.isfinite(from_nothing).all()
    assert np.isfinite(gradient_operator(collapsed, faces).data).all()
    assert abs(gradient_operator(collapsed, faces)[:3]).sum() == 0


def test_the_operator_reads_the_tangential_part_of_the_gradients() -> None:
    vertices, faces = bumpy_sheet(5)
    pose = vertices + torch.randn(vertices.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    read = torch.from_numpy(gradient_operator(vertices, faces) @ pose.numpy()).view(-1, 3, 3)
    normals = triangle_normals(vertices, faces)
    plane = torch.eye(3, dtype=torch.float64) - normals[:, :, None] * normals[:, None, :]
    gradients = deformation_gradients(vertices, pose, faces)
    torch.testing.assert_close(read, plane @ gradients.transpose(-1, -2), atol=1e-8, rtol=0)


def test_moving_everything_alike_has_no_gradient() -> None:
    vertices, faces = bumpy_sheet(6)
    assert abs(gradient_operator(vertices, faces) @ np.ones(len(vertices))).max() < 1e-12


def test_gradients_are_differentiable() -> None:
    vertices, faces = bumpy_sheet(7, count=8)
    pose = (vertices * 1.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda moved: deformation_gradients(vertices, moved, faces), (pose,))
