"""Solvers that the tests of several graphs share."""

import pytest
import torch

from torchface import Attachment, BlendshapeRig, Mesh
from torchface.capture import MarkerSolver
from torchface.geometry.similarity import Similarity


@pytest.fixture(scope="module")
def bump_rig() -> BlendshapeRig:
    """A sheet of 12 × 12 vertices, 110 mm wide, with 10 bumps of very different size that overlap."""
    line = torch.linspace(-55, 55, 12)
    x, y = torch.meshgrid(line, line, indexing="xy")
    vertices = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    corner = (torch.arange(11)[:, None] * 12 + torch.arange(11)).reshape(-1, 1)
    faces = torch.cat([corner + torch.tensor([0, 1, 13]), corner + torch.tensor([0, 13, 12])])
    generator = torch.Generator().manual_seed(0)
    centers = vertices[torch.randperm(144, generator=generator)[:10]]
    directions = torch.nn.functional.normalize(torch.randn(10, 1, 3, generator=generator), dim=-1)
    size = torch.logspace(0, 1.3, 10)[:, None, None]
    near = torch.exp(-torch.cdist(centers, vertices).square() / (2 * 20.0**2))
    return BlendshapeRig(Mesh(vertices, faces), near[..., None] * directions * size, [f"shape{i}" for i in range(10)])


@pytest.fixture(scope="module")
def bump_sites(bump_rig: BlendshapeRig) -> Attachment:
    return Attachment.from_vertices(bump_rig.neutral, range(0, 144, 4), [f"m{i}" for i in range(36)])


@pytest.fixture(scope="module")
def bumps(bump_rig: BlendshapeRig, bump_sites: Attachment) -> MarkerSolver:
    return MarkerSolver(bump_rig, bump_sites)


@pytest.fixture(scope="module")
def turned_bumps(bump_rig: BlendshapeRig, bump_sites: Attachment) -> MarkerSolver:
    return MarkerSolver(bump_rig, bump_sites, turned())


def turned() -> Similarity:
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(6)))[0]
    rotation = rotation * torch.linalg.det(rotation).sign()
    return Similarity(torch.tensor([0.8]), rotation[None], torch.tensor([[10.0, -20.0, 300.0]]))
