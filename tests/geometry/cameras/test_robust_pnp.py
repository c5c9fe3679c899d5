"""Planted cameras come back although a third of the points is seen where it is not."""

import functools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.pnp import pixel_jacobian, solve_pnp
from torchface.geometry.cameras.robust_pnp import robust_pnp
from torchface.synthetic import neutral_head

K = torch.tensor([[900.0, 0, 319.5], [0, 900, 239.5], [0, 0, 1]], dtype=torch.float64)
FEW = torch.tensor([0, 1, 15, 16, 27, 28, 29, 30, 31, 33, 35, 36, 39, 42, 45])


@functools.cache
def face() -> Tensor:
    mesh = neutral_head()
    return mesh.vertices[mesh.landmarks].double()


def filmed(count: int, noise: float = 0.0, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points, rotations, translations, pixels of faces half a metre to a metre away, turned by up to 45°."""
    generator = torch.Generator().manual_seed(seed)
    points = face().clone()
    upright = torch.diag(torch.tensor([1.0, -1, -1]).double())
    angles = (torch.rand(count, 3, generator=generator).double() - 0.5) * 1.5
    rotation = upright @ torch.from_numpy(Rotation.from_euler("xyz", angles.numpy()).as_matrix())
    translation = torch.rand(count, 3, generator=generator).double() - 0.5
    translation = translation * torch.tensor([200.0, 200, 500]).double() + torch.tensor([0.0, 0, 750]).double()
    pixels, _ = pixel_jacobian(points @ rotation.transpose(1, 2) + translation[:, None], K)
    return points, rotation, translation, pixels + noise * torch.randn(pixels.shape, generator=generator).double()


def spoiled(pixels: Tensor, share: float, seed: int = 1) -> tuple[Tensor, Tensor]:
    """Pixels of which a share is 20 to 150 pixels off, and which they are."""
    generator = torch.Generator().manual_seed(seed)
    bad = torch.rand(pixels.shape[:2], generator=generator) < share
    angle = 6.3 * torch.rand(pixels.shape[:2], generator=generator).double()
    far = 20 + 130 * torch.rand(pixels.shape[:2], generator=generator).double()
    off = far[..., None] * torch.stack([angle.cos(), angle.sin()], dim=-1)
    return torch.where(bad[..., None], pixels + off, pixels), bad


def degrees(one: Tensor, other: Tensor) -> Tensor:
    return (2 * ((one - other).flatten(-2).norm(dim=-1) / 8**0.5).clamp(max=1).asin()).rad2deg()


def test_thirty_percent_of_gross_outliers() -> None:
    points, rotation, translation, clean = filmed(150, noise=0.5)
    pixels, bad = spoiled(clean, 0.3)
    found = robust_pnp(points, pixels, K, threshold=2.5)
    assert found.found.all()
    assert not (found.inliers & bad).any()
    assert (found.inliers & ~bad).sum() > 0.99 * (~bad).sum()
    # As good as least squares that was told which points to believe.
    told = solve_pnp(points, clean, K, (~bad).double())
    assert float(degrees(found.pose.rotation, told.rotation).max()) < 0.05
    off = (found.pose.translation - translation).norm(dim=-1)
    assert float(off.mean()) < 1.05 * float((told.translation - translation).norm(dim=-1).mean())
    assert float(degrees(found.pose.rotation, rotation).mean()) < 0.2


@pytest.mark.parametrize("share", [0.3, 0.45])
def test_better_than_opencv_from_few_points(share: float) -> None:
    cv2 = pytest.importorskip("cv2")
    points, rotation, _, clean = filmed(80, noise=0.7)
    points, (pixels, _) = points[FEW], spoiled(clean[:, FEW], share)
    found, theirs = robust_pnp(points, pixels, K, threshold=3.0), []
    for frame in pixels.numpy():  # OpenCV takes one view at a time
        good, turn, move, inliers = cv2.solvePnPRansac(
            points.numpy(), frame, K.numpy(), None, iterationsCount=256, reprojectionError=3.0
        )
        if good and inliers is not None and len(inliers) > 3:
            kept = inliers[:, 0]
            turn, move = cv2.solvePnPRefineLM(points.numpy()[kept], frame[kept], K.numpy(), None, turn, move)
        theirs.append(torch.from_numpy(cv2.Rodrigues(turn)[0]))
    errors = [degrees(each, rotation).nan_to_num(180.0) for each in (found.pose.rotation, torch.stack(theirs))]
    assert float(errors[0].mean()) < float(errors[1].mean())
    assert float(errors[0].median()) < 1.05 * float(errors[1].median())
    assert int((errors[0] > 10).sum()) <= int((errors[1] > 10).sum())


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.floats(0, 0.3))
def test_a_frame_does_not_depend_on_the_others(seed: int, share: float) -> None:
    points, _, _, clean = filmed(4, 0.5, seed)
    pixels, _ = spoiled(clean, share, seed)
    pixels[2, ::3] = torch.nan
    together = robust_pnp(points, pixels, K)
    alone = robust_pnp(points, pixels[2:3], K)
    assert torch.equal(together.inliers[2:3], alone.inliers)
    torch.testing.assert_close(together.pose.rotation[2:3], alone.pose.rotation, rtol=0, atol=1e-6)
    assert not together.inliers[2, ::3].any()
    identity = together.pose.rotation @ together.pose.rotation.transpose(1, 2)
    torch.testing.assert_close(identity, torch.eye(3).double().expand(4, 3, 3))
    assert torch.linalg.det(together.pose.rotation).min() > 0.999


def test_frames_without_enough_points_have_no_pose() -> None:
    points, _, _, pixels = filmed(4)
    pixels[1, 3:] = torch.nan
    pixels[2] = 500 * torch.rand(68, 2, generator=torch.Generator().manual_seed(0)).double()
    found = robust_pnp(points[:20], pixels[:, :20], K, threshold=0.2)
    assert found.found.tolist() == [True, False, False, True]
    assert found.pose.rotation[1].isnan().all()
    assert not found.inliers[1:3].any()
    none = robust_pnp(points, torch.full((2, 68, 2), torch.nan), K)
    assert not none.found.any()
    assert robust_pnp(points, pixels[:0], K).inliers.shape == (0, 68)


def test_weights() -> None:
    points, rotation, _, pixels = filmed(6)
    weights = torch.ones(68).double()
    weights[:17] = 0
    pixels[:, :17] += 300.0
    found = robust_pnp(points, pixels, K, weights=weights)
    assert not found.inliers[:, :17].any()
    assert float(degrees(found.pose.rotation, rotation).max()) < 1e-3
    # What weighs a quarter may have twice the residual.
    clean = filmed(6)[3]
    clean[:, 30, 0] += 6.0
    weights = torch.ones(68).double()
    assert not robust_pnp(points, clean, K).inliers[:, 30].any()
    weights[30] = 0.25
    assert robust_pnp(points, clean, K, weights=weights).inliers[:, 30].all()


def test_bad_input_is_named() -> None:
    points, _, _, pixels = filmed(2)
    with pytest.raises(ShapeError, match=r"points \(67, 3\) and pixels \(2, 68, 2\)"):
        robust_pnp(points[1:], pixels, K)
    with pytest.raises(ShapeError, match=r"intrinsics: found \(2, 3, 3\)"):
        robust_pnp(points, pixels, K.expand(2, 3, 3))
    with pytest.raises(ShapeError, match=r"weights: found \(3,\)"):
        robust_pnp(points, pixels, K, weights=torch.ones(3))
    with pytest.raises(ShapeError, match="found 3 points"):
        robust_pnp(points[:3], pixels[:, :3], K)
    with pytest.raises(ValueRangeError, match="threshold 0"):
        robust_pnp(points, pixels, K, threshold=0.0)
    with pytest.raises(ValueRangeError, match="negative or infinite weight"):
        robust_pnp(points, pixels, K, weights=-torch.ones(68))
    with pytest.raises(ValueRangeError, match="NaN or infinite points"):
        robust_pnp(points * torch.nan, pixels, K)
