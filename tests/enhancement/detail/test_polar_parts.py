"""Rotation and stretch of gradients: as scipy has them, mirrored and singular ones included, with derivatives."""

import numpy as np
import pytest
import torch
from scipy.linalg import polar

from torchface.enhancement.detail.polar_parts import decode_gradients, encode_gradients, polar_parts
from torchface.geometry.rotations import rotation_matrix


@pytest.fixture(scope="module")
def gradients() -> torch.Tensor:
    torch.manual_seed(0)
    turned = rotation_matrix(2.0 * torch.randn(300, 3, dtype=torch.float64))
    mixed = rotation_matrix(torch.randn(300, 3, dtype=torch.float64))
    stretch = mixed @ torch.diag_embed(torch.logspace(-1.5, 1.5, 900).double().view(300, 3)) @ mixed.transpose(1, 2)
    return (turned @ stretch)[torch.randperm(300)]


def test_as_scipy_decomposes_them(gradients):
    rotation, stretch = polar_parts(gradients)
    for k in range(0, 300, 7):
        u, p = polar(gradients[k].numpy())
        assert np.allclose(rotation[k], u, atol=1e-9)
        assert np.allclose(stretch[k], p, atol=1e-8 * float(gradients[k].norm()))
    single, _ = polar_parts(gradients.float())
    assert torch.allclose(single.double(), rotation, atol=2e-5)


def test_mirrored_and_singular_gradients_get_their_nearest_rotation():
    torch.manual_seed(1)
    made = torch.randn(50, 3, 3).double()
    made[torch.linalg.det(made) > 0, 0] *= -1
    made[0] = torch.diag(torch.tensor([1.0, 1.0, 0.0]))
    made[1] = 0.0
    rotation, stretch = polar_parts(made.view(2, 25, 3, 3))
    rotation, stretch = rotation.view(50, 3, 3), stretch.view(50, 3, 3)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(50).double())
    assert torch.allclose(rotation @ stretch, made, atol=1e-9)
    others = rotation_matrix(torch.randn(50, 2000, 3).double())
    distance = (others - made[:, None]).square().sum((-1, -2)).amin(1)
    assert bool(((rotation - made).square().sum((-1, -2)) <= distance + 1e-9).all())
    tiny, _ = polar_parts(1e-18 * torch.eye(3)[None])
    assert torch.allclose(tiny, torch.eye(3)[None])


def test_nine_numbers_and_back(gradients):
    parts = encode_gradients(gradients)
    assert parts.shape == (300, 9)
    assert torch.allclose(decode_gradients(parts), gradients, atol=1e-7)
    assert float(encode_gradients(torch.eye(3)[None]).abs().max()) < 1e-6


def test_derivatives_are_those_of_finite_differences(gradients):
    torch.manual_seed(2)
    near = torch.eye(3).double() + 0.3 * torch.randn(4, 3, 3).double()
    near[0] = torch.diag(torch.tensor([1.2, 0.9, -0.3]))
    near.requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: polar_parts(x), (near,), fast_mode=True)
    assert torch.autograd.gradcheck(encode_gradients, (near[1:].detach().requires_grad_(True),), fast_mode=True)
