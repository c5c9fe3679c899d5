"""A small rig on which the marker solvers are tried."""

import pytest
import torch

from torchface import Attachment, BlendshapeRig, Mesh
from torchface.geometry.similarity import Similarity
from torchface.synthetic import performer
from torchface.synthetic.stages import perform, place_markers


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


@pytest.fixture(scope="session")
def performance() -> tuple[BlendshapeRig, Attachment, list[torch.Tensor]]:
    """The embedded performer, 100 markers on it, and two takes of half a minute as its weights, (T,51) each."""
    rig = performer(texture=False)
    generator = torch.Generator().manual_seed(0)
    tracks = [perform(1850, generator).weights for _ in range(2)]
    return rig, place_markers(rig, 100), [rig.weights_from(track) for track in tracks if track is not None]


@pytest.fixture(scope="session")
def stage_space() -> Similarity:
    """Rig space as a stage might see it: turned, elsewhere, a little larger."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(5)))[0]
    turn = turn * torch.linalg.det(turn).sign()
    return Similarity(torch.tensor([1.07]), turn[None], torch.tensor([[100.0, -900.0, 40.0]]))
