"""The pose of a template on a scan, planted and found again."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchface.errors import AlignmentError
from torchface.geometry.meshes.rigid_icp import Samples, ScanPoints, find_pose, rigid_icp
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh


@pytest.fixture(scope="module")
def samples(mask: Mesh) -> Samples:
    return Samples.of(mask.vertices, mask.faces, torch.arange(len(mask.vertices)))


@pytest.mark.parametrize("seed", range(2))
def test_any_pose_is_found_by_shape_alone(mask, samples, moved, make_mask, seed: int) -> None:
    finer = make_mask(50, 70)
    found = find_pose(samples, ScanPoints.of(moved(finer.vertices, seed), finer.faces)).pose
    assert float((found.apply(mask.vertices)[0] - moved(mask.vertices, seed)).norm(dim=1).max()) < 1.0


def test_a_scan_larger_and_with_other_parts_is_found_too(mask, samples, moved, make_mask) -> None:
    finer = make_mask(50, 70)
    plate = finer.vertices * torch.tensor([1.5, 0.3, 0.0]) + torch.tensor([0.0, -150.0, -20.0])
    both = torch.cat([finer.vertices, plate])
    scan = ScanPoints.of(moved(both, 7, 1.1), torch.cat([finer.faces, finer.faces + len(finer.vertices)]))
    found = find_pose(samples, scan).pose
    assert float((found.apply(mask.vertices)[0] - moved(mask.vertices, 7, 1.1)).norm(dim=1).mean()) < 1.5
    assert float(found.scale[0]) == pytest.approx(1.1, abs=0.02)


def test_what_fits_nowhere_is_refused(samples) -> None:
    generator = torch.Generator().manual_seed(0)
    cloud = torch.randn(900, 3, generator=generator, dtype=torch.float64) * 60
    with pytest.raises(AlignmentError, match="best fit"):
        find_pose(samples, ScanPoints.of(cloud, torch.arange(900).reshape(-1, 3)))


def test_rigid_icp_undoes_a_small_motion_from_many_starts(mask, samples) -> None:
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(size=(5, 3)) * 0.1).as_matrix()
    shifts = torch.randn(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 5
    start = Similarity(torch.ones(5).double(), torch.from_numpy(turns), shifts)
    fits = rigid_icp(samples, ScanPoints.of(mask.vertices, mask.faces), start, (20.0,) * 25)
    assert float((fits.pose.apply(mask.vertices) - mask.vertices).norm(dim=-1).mean(1).max()) < 0.2
    assert torch.allclose(fits.pose.scale, torch.ones(5, dtype=torch.float64))


def test_scale_is_estimated_when_asked(mask, samples) -> None:
    start = Similarity(torch.full((1,), 0.95).double(), torch.eye(3).double()[None], torch.zeros(1, 3).double())
    fit = rigid_icp(samples, ScanPoints.of(mask.vertices, mask.faces), start, (20.0,) * 30, scale=True)
    assert float(fit.pose.scale[0]) == pytest.approx(1.0, abs=5e-3)


def test_landmarks_hold_where_the_shape_lets_slide() -> None:
    """On a plane only the landmarks tell where along it."""
    x, y = torch.meshgrid(torch.arange(0, 100.0, 5), torch.arange(0, 100.0, 5), indexing="ij")
    points = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3).double()
    ids = torch.arange(400).reshape(20, 20)
    a, b, c, d = (corner.reshape(-1) for corner in (ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]))
    plane = ScanPoints.of(points, torch.cat([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)]))
    inner = (points[:, :2] - 47.5).abs().amax(1) < 20
    flat = Samples(points[inner], torch.tensor([0.0, 0.0, 1.0]).double().expand(int(inner.sum()), 3))
    shift = torch.tensor([[6.0, -4.0, 3.0]], dtype=torch.float64)
    start = Similarity(torch.ones(1).double(), torch.eye(3).double()[None], shift)
    picked = flat.points[[0, 5, 20]]
    pose = rigid_icp(flat, plane, start, (20.0,) * 10, landmarks=(picked, picked)).pose
    assert float((pose.apply(picked)[0] - picked).norm(dim=1).max()) < 0.05
