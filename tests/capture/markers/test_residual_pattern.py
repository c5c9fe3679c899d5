"""A smooth residual over the face is another head's; noise, a similarity and a stand-off are not."""

import pytest
import torch

from torchface.capture.markers.residual_pattern import residual_pattern


@pytest.mark.parametrize("seed", range(3))
def test_only_what_neighbours_share_counts(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    points = 60 * torch.randn(80, 3, generator=generator).double() * torch.tensor([1, 1, 0.4])
    normals = torch.nn.functional.normalize(points, dim=1)
    smooth = 2 * torch.sin(points[:, [1, 2, 0]] / 40 + seed)
    noise = 3 * torch.randn(80, 3, generator=generator).double()
    assert residual_pattern(smooth, points, normals).other_head
    assert not residual_pattern(noise, points, normals).other_head
    moved = 0.05 * points + torch.linalg.cross(torch.tensor([0.1, 0, 0.05]).double().expand(80, 3), points) + 3.0
    for harmless in (moved, 2.5 * normals, moved + 2.5 * normals):
        found = residual_pattern(harmless, points, normals)
        assert found.smooth < 1e-6
        assert not found.other_head
    hidden = smooth.clone()
    hidden[:70] = torch.nan
    assert residual_pattern(hidden, points, normals).smooth == 0.0
