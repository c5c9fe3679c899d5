"""Rotations from vectors agree with scipy's, also where the angle is tiny."""

import torch
from scipy.spatial.transform import Rotation

from torchface.geometry.rotations import cross_matrix, rotation_matrix, rotation_vector


def test_agrees_with_scipy() -> None:
    vectors = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).double()
    vectors[:10] *= 1e-7
    vectors[10] = 0.0
    expected = torch.from_numpy(Rotation.from_rotvec(vectors.numpy()).as_matrix())
    torch.testing.assert_close(rotation_matrix(vectors), expected, rtol=0, atol=1e-14)


def test_cross_matrix_multiplies_as_the_cross_product() -> None:
    a, b = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(1)).double()
    torch.testing.assert_close((cross_matrix(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


def test_vectors_come_back() -> None:
    vectors = torch.randn(200, 3, generator=torch.Generator().manual_seed(2)).double()
    vectors = vectors / vectors.norm(dim=1, keepdim=True) * torch.linspace(0, torch.pi - 1e-6, 200).double()[:, None]
    vectors[:20] *= 1e-6
    torch.testing.assert_close(rotation_vector(rotation_matrix(vectors)), vectors, rtol=0, atol=1e-7)
    expected = torch.from_numpy(Rotation.from_matrix(rotation_matrix(vectors).numpy()).as_rotvec())
    torch.testing.assert_close(rotation_vector(rotation_matrix(vectors))[:190], expected[:190], rtol=0, atol=1e-12)


def test_gradients_where_there_is_no_angle() -> None:
    zero = torch.zeros(3, dtype=torch.float64)
    found = torch.autograd.functional.jacobian(rotation_matrix, zero)
    torch.testing.assert_close(found, cross_matrix(torch.eye(3, dtype=torch.float64)).permute(1, 2, 0))
    assert torch.autograd.gradcheck(rotation_matrix, torch.tensor([[0.3, -1.2, 0.5]]).double().requires_grad_())
