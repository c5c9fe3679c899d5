"""Errors are what a plain loop over frames would say they are."""

import pytest
import torch

from torchface.attachment import Attachment
from torchface.errors import ShapeError
from torchface.evaluation import marker_rmse, mesh_error, weight_error
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig


def random_rig(seed: int) -> BlendshapeRig:
    generator = torch.Generator().manual_seed(seed)
    mesh = Mesh(torch.randn(9, 3, generator=generator), torch.arange(9).reshape(3, 3))
    return BlendshapeRig(mesh, torch.randn(4, 9, 3, generator=generator), list("abcd"))


def test_mesh_error_equals_the_plain_loop_whatever_the_chunk() -> None:
    solved_rig, true_rig = random_rig(0), random_rig(1)
    solved, true = torch.rand(2, 10, 4, generator=torch.Generator().manual_seed(2))
    keep = torch.tensor([0, 3, 4, 8])
    distance = torch.stack(
        [(solved_rig(solved[t : t + 1]) - true_rig(true[t : t + 1]))[0, keep].norm(dim=1) for t in range(10)]
    )
    motion = torch.stack([(true_rig(true[t : t + 1])[0] - true_rig.vertices)[keep].norm(dim=1) for t in range(10)])
    for chunk in (3, 64):
        found = mesh_error(solved_rig, solved, true_rig, true, keep, chunk)
        torch.testing.assert_close(found.vertex_mean, distance.mean(0))
        torch.testing.assert_close(found.vertex_largest, distance.amax(0))
        torch.testing.assert_close(found.frame_mean, distance.mean(1))
        assert found.relative == pytest.approx(float(distance.mean() / motion.mean()), rel=1e-5)


def test_marker_rmse_leaves_unseen_markers_out() -> None:
    rig = random_rig(3)
    attachment = Attachment.from_vertices(rig.neutral, [0, 4, 8])
    weights = torch.rand(5, 4, generator=torch.Generator().manual_seed(4))
    markers = rig(weights)[:, [0, 4, 8]]
    offset = torch.tensor([[3.0, 0, 0], [0, 4, 0], [0, 0, 12]])
    shifted = markers + offset
    shifted[1, 2] = torch.nan
    shifted[2] = torch.nan
    rmse = marker_rmse(rig, attachment, weights, shifted)
    assert rmse[0] == pytest.approx((169 / 3) ** 0.5, rel=1e-5)
    assert rmse[1] == pytest.approx((25 / 2) ** 0.5, rel=1e-5)
    assert torch.isnan(rmse[2])


def test_weight_error_is_zero_and_fully_correlated_on_itself() -> None:
    true = torch.rand(50, 3, generator=torch.Generator().manual_seed(5))
    true[:, 2] = 0.25
    found = weight_error(true * 0.5, true)
    torch.testing.assert_close(found.mean, true.mean(0) / 2)
    torch.testing.assert_close(found.correlation[:2], torch.ones(2))
    assert torch.isnan(found.correlation[2])
    with pytest.raises(ShapeError, match=r"\(50, 3\) and \(49, 3\)"):
        weight_error(true, true[1:])
