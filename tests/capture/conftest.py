"""A small rig on which the marker solvers are tried."""

from __future__ import annotations

import pytest
import torch

from torchface import Attachment, BlendshapeRig, Mesh


@pytest.fixture(scope="session")
def small_rig() -> BlendshapeRig:
    """A bent sheet of 15 × 15 vertices, 100 mm wide, with 12 bumps that overlap."""
    line = torch.linspace(-50, 50, 15)
    x, y = torch.meshgrid(line, line, indexing="xy")
    vertices = torch.stack([x, y, 20 - 0.01 * (x**2 + y**2)], -1).reshape(-1, 3)
    corner = (torch.arange(14)[:, None] * 15 + torch.arange(14)).reshape(-1, 1)
    faces = torch.cat([corner + torch.tensor([0, 1, 16]), corner + torch.tensor([0, 16, 15])])
    generator = torch.Generator().manual_seed(0)
    centers = vertices[torch.randperm(225, generator=generator)[:12]]
    directions = 8 * torch.nn.functional.normalize(torch.randn(12, 1, 3, generator=generator), dim=-1)
    near = torch.exp(-torch.cdist(centers, vertices).square() / (2 * 25.0**2))
    return BlendshapeRig(Mesh(vertices, faces), near[..., None] * directions, [f"shape{i}" for i in range(12)])


@pytest.fixture(scope="session")
def small_attachment(small_rig: BlendshapeRig) -> Attachment:
    """Forty markers inside triangles spread over the sheet."""
    generator = torch.Generator().manual_seed(1)
    triangles = torch.randperm(len(small_rig.neutral.faces), generator=generator)[:40]
    corners = torch.rand(40, 3, generator=generator)
    return Attachment(triangles, corners / corners.sum(1, keepdim=True))
