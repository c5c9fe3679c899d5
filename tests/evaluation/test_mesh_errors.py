"""Errors are what a plain loop over frames would say they are."""

import numpy as np
import pytest
import torch

from torchface import Attachment, BlendshapeRig, Mesh
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.evaluation import (
    error_figures,
    marker_rmse,
    mesh_error,
    region_figures,
    rigidly_aligned,
    shape_errors,
    vertex_errors,
    weight_error,
)
from torchface.geometry.rotations import rotation_matrix


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


def planted(frames: int = 3, vertices: int = 40) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """True vertices, found ones, and the distances planted between them."""
    generator = torch.Generator().manual_seed(6)
    true = 50 * torch.randn(frames, vertices, 3, generator=generator, dtype=torch.float64)
    length = 4 * torch.rand(frames, vertices, generator=generator, dtype=torch.float64)
    way = torch.nn.functional.normalize(torch.randn(frames, vertices, 3, generator=generator).double(), dim=-1)
    return true, true + length[..., None] * way, length


def test_a_planted_displacement_gives_exactly_this_error() -> None:
    true, found, length = planted()
    torch.testing.assert_close(vertex_errors(found, true), length)
    figures = error_figures(vertex_errors(found, true))
    values = np.sort(length.flatten().numpy())
    assert figures.mean == pytest.approx(values.mean())
    assert figures.median == pytest.approx(np.median(values))
    assert figures.percentile_95 == pytest.approx(np.percentile(values, 95))
    assert figures.largest == pytest.approx(values[-1])
    assert figures.total == pytest.approx(float(length.sum(1).mean()))
    assert figures.vertices == 40


def test_what_is_nan_was_not_compared() -> None:
    true, found, length = planted()
    found[0, 5], true[1, 6], found[2] = torch.nan, torch.nan, torch.nan
    keep = torch.ones(3, 40, dtype=torch.bool)
    keep[0, 5], keep[1, 6], keep[2] = False, False, False
    figures = error_figures(vertex_errors(found, true))
    assert figures.mean == pytest.approx(float(length[keep].mean()))
    assert figures.total == pytest.approx(float((length * keep)[:2].sum(1).mean()))
    with pytest.raises(ValueRangeError, match="no distance"):
        error_figures(vertex_errors(found * torch.nan, true))


def test_alignment_removes_a_planted_motion_and_nothing_else() -> None:
    true, _, _ = planted()
    turn = rotation_matrix(torch.tensor([[0.1, 0.2, -0.1], [0, 0.3, 0], [0.0, 0, 0]], dtype=torch.float64))
    moved = true @ turn.transpose(1, 2) + torch.tensor([5.0, -30.0, 9.0], dtype=torch.float64)
    laid = rigidly_aligned(moved, true)
    torch.testing.assert_close(laid.vertices, true, atol=1e-9, rtol=0)
    expected = torch.rad2deg(torch.tensor([0.06**0.5, 0.3, 0.0], dtype=torch.float64))
    torch.testing.assert_close(laid.degrees, expected, atol=1e-5, rtol=0)
    larger = rigidly_aligned(1.1 * true, true)
    assert float(vertex_errors(larger.vertices, true).mean()) > 3  # size is no motion
    gone = moved.clone()
    gone[:, 7] = torch.nan
    again = rigidly_aligned(gone, true).vertices
    torch.testing.assert_close(again[:, 8:], true[:, 8:], atol=1e-9, rtol=0)


def test_figures_of_a_region_are_those_of_its_vertices() -> None:
    _, _, length = planted()
    half = torch.arange(40) < 20
    figures = region_figures(length, {"half": half, "none": torch.zeros(40, dtype=torch.bool)})
    assert list(figures) == ["half"]
    assert figures["half"] == error_figures(length[:, :20])
    with pytest.raises(ShapeError, match=r"regions\['half'\]"):
        region_figures(length, {"half": half[:9]})


def test_weights_by_other_names_are_compared_shape_by_shape() -> None:
    generator = torch.Generator().manual_seed(7)
    true = torch.rand(30, 3, generator=generator)
    found = torch.stack([true[:, 1] + 0.1, true[:, 0], true[:, 0]], 1)
    found[4] = torch.nan
    names = ("eyeBlink_L", "browInnerUp_L", "browInnerUp_R")
    compared = shape_errors(found, names, true, ("browInnerUp", "eyeBlinkLeft", "jawOpen"))
    assert compared.names == ("browInnerUp", "eyeBlinkLeft")
    assert compared.missing == ("jawOpen",)
    assert compared.frames == 29
    torch.testing.assert_close(compared.error.mean, torch.tensor([0.0, 0.1]), atol=1e-6, rtol=0)
    with pytest.raises(NameMismatchError, match="expected some of jawOpen"):
        shape_errors(found, ("x", "y", "z"), true, ("jawOpen", "jawLeft", "jawRight"))
