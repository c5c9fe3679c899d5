"""Both ways to encode detail: what was taken off comes back, they agree where detail is slight, derivatives."""

import pytest
import torch

from torchface.enhancement.detail.detail_encodings import DisplacementDetail, GradientDetail
from torchface.enhancement.detail.low_pass import LowPass
from torchface.geometry.meshes.operators import border_vertices, vertex_normals
from torchface.geometry.rotations import rotation_matrix


@pytest.fixture(scope="module")
def sheet():
    """A bent sheet of 20 x 16 vertices, 2 mm apart."""
    y, x = torch.meshgrid(torch.arange(16.0), torch.arange(20.0), indexing="ij")
    vertices = torch.stack([2 * x, 2 * y, 6 * (x / 8).sin() + 3 * (y / 6).cos()], dim=-1).view(-1, 3).double()
    corner = (torch.arange(15)[:, None] * 20 + torch.arange(19)).flatten()
    faces = torch.cat(
        [torch.stack([corner, corner + 1, corner + 21], 1), torch.stack([corner, corner + 21, corner + 20], 1)]
    )
    return vertices, faces


def _bent(vertices, size):
    """Smooth: one corner goes along z, and the whole turns."""
    reach = (vertices[:, 0] / 40 + vertices[:, 1] / 30).clamp(min=0)
    moved = vertices + size * torch.stack([0 * reach, reach, reach.square()], dim=1)
    return moved @ rotation_matrix(torch.tensor([0.0, 0.3, 0.1]).double()).T


def _wrinkled(vertices, neutral, faces, height):
    waves = height * (2.0 * neutral[:, 0]).sin() * (-((neutral[:, 1] - 15) / 6).square()).exp()
    return vertices + waves[:, None] * vertex_normals(vertices, faces)


@pytest.mark.parametrize("kind", [DisplacementDetail, GradientDetail])
def test_a_frame_comes_back_and_its_detail_turns_with_the_smooth_part(kind, sheet):
    neutral, faces = sheet
    detail = kind(neutral, faces)
    low = torch.stack([_bent(neutral, 5.0), _bent(neutral, 12.0)])
    frames = torch.stack([_wrinkled(one, neutral, faces, 0.4) for one in low])
    found = detail.encode(low, frames)
    # Gradients hold borders to the bends of the smooth part, a little.
    assert torch.allclose(detail.compose(low, found), frames, atol=1e-9 if kind is DisplacementDetail else 0.01)
    # On the other smooth part: the wrinkles of that one, as far as wrinkles made along its normals are the same.
    swapped = detail.compose(low.flip(0), found)
    height = (frames - low).norm(dim=-1).max()
    assert float((swapped - frames.flip(0)).norm(dim=-1).max()) < 0.2 * float(height)


def test_both_agree_where_the_detail_is_slight(sheet):
    neutral, faces = sheet
    low = _bent(neutral, 8.0)[None]
    other = _bent(neutral, 9.0)[None]
    frames = _wrinkled(low[0], neutral, faces, 0.02)[None]
    by_displacement, by_gradient = (
        kind(neutral, faces).compose(other, kind(neutral, faces).encode(low, frames))
        for kind in (DisplacementDetail, GradientDetail)
    )
    assert float((by_displacement - by_gradient).norm(dim=-1).max()) < 0.1 * float((frames - low).norm(dim=-1).max())


def test_no_detail_leaves_borders_and_all_else_as_they_are(sheet):
    neutral, faces = sheet
    low = _bent(neutral, 8.0)[None]
    detail = GradientDetail(neutral, faces)
    assert torch.allclose(detail.compose(low, torch.zeros(1, 9 * len(faces)).double()), low, atol=1e-9)
    # A stretch of the middle alone: borders keep their bends, in spite of gradients that no surface has.
    strain = torch.zeros(9, len(faces)).double()
    strain[3] = 0.3 * (neutral[faces].mean(1)[:, 0].sub(20).abs() < 8)
    moved = detail.compose(low, strain.view(1, -1))[0] - low[0]
    border = border_vertices(faces, len(neutral))
    assert float(moved[border].norm(dim=1).max()) < 1.2 * float(moved[~border].norm(dim=1).max())


@pytest.mark.parametrize("kind", [DisplacementDetail, GradientDetail])
def test_derivatives_are_those_of_finite_differences(kind, sheet):
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0.3], [4, 0, 0], [0, 2, 0], [2, 2, 0.5], [4, 2, 0.1]]).double()
    faces = torch.tensor([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    detail, low_pass = kind(vertices, faces), LowPass(vertices, faces, 5.0)
    torch.manual_seed(0)
    details = 0.05 * torch.randn(1, 18 if kind is DisplacementDetail else 36).double()
    moved = (0.3 * torch.randn(1, 6, 3).double()).requires_grad_(True)

    def composed(displacements, details):
        return detail.compose(vertices + low_pass(displacements), details)

    assert torch.autograd.gradcheck(composed, (moved, details.requires_grad_(True)), fast_mode=True)
    assert torch.autograd.gradcheck(
        lambda x: detail.encode(vertices + low_pass(x), vertices + x), (moved,), fast_mode=True
    )
