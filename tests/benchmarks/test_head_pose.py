"""Head pose beside OpenCV's solvePnPRansac, and what filtering live costs and gains; one thread, processor time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from torchface.capture.video.head_pose import STABLE_LANDMARKS, PoseTracker, filter_poses, measure_poses, smooth_poses
from torchface.capture.video.landmark_smoothing import LandmarkFilter
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.pnp import pixel_jacobian
from torchface.geometry.cameras.robust_pnp import robust_pnp
from torchface.geometry.rotations import rotation_matrix, rotation_vector
from torchface.synthetic import neutral_head

K = assumed_calibration(640, 480).intrinsics
UPRIGHT = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
FRAMES = 300


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def filmed(noise: float, size: float = 1.0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Landmarks at rest, rotations, translations, pixels of a head that turns, nods and moves, 30 frames a second."""
    mesh, moment = neutral_head(), torch.arange(FRAMES, dtype=torch.float64) / 30

    def swing(most: float, phase: float) -> Tensor:
        quick = 0.3 * (2 * math.pi * 0.9 * moment + 2 * phase).cos()
        return size * most * ((2 * math.pi * 0.4 * moment + phase).sin() + quick)

    rotation = UPRIGHT @ rotation_matrix(torch.stack([swing(0.2, 0.3), swing(0.45, 1), swing(0.12, 2)], dim=1))
    translation = torch.stack([swing(40, 0.5), swing(20, 1.5), swing(50, 2.5)], dim=1)
    translation = translation + torch.tensor([0.0, 0, 600], dtype=torch.float64)
    points = mesh.vertices[mesh.landmarks].double()
    pixels, _ = pixel_jacobian(points @ rotation.transpose(1, 2) + translation[:, None], K)
    generator = torch.Generator().manual_seed(1)
    return points, rotation, translation, pixels + noise * torch.randn(pixels.shape, generator=generator).double()


def seconds(run: Callable[[], object]) -> float:
    begin = time.process_time()
    run()
    return time.process_time() - begin


def degrees(one: Tensor, other: Tensor) -> Tensor:
    return rotation_vector(one @ other.transpose(1, 2)).norm(dim=1).rad2deg().nan_to_num(180.0)


@pytest.mark.parametrize("count", [68, len(STABLE_LANDMARKS)])
def test_robust_pnp_beside_opencv(count: int) -> None:
    cv2 = pytest.importorskip("cv2")
    cv2.setNumThreads(1)
    kept = torch.arange(68) if count == 68 else torch.tensor(STABLE_LANDMARKS)
    points, rotation, translation, pixels = filmed(1.0)
    points, pixels = points[kept], pixels[:, kept]
    generator = torch.Generator().manual_seed(2)
    wrong = torch.rand(pixels.shape[:2], generator=generator) < 0.3
    off = 300 * (torch.rand(pixels.shape, generator=generator).double() - 0.5)
    pixels = torch.where(wrong[..., None], pixels + off, pixels)
    theirs: list[tuple[Tensor, Tensor]] = []

    def opencv() -> None:
        for frame in pixels.numpy():  # OpenCV takes one view at a time
            good, turn, move, inliers = cv2.solvePnPRansac(
                points.numpy(), frame, K.numpy(), None, iterationsCount=256, reprojectionError=4.0
            )
            if good and inliers is not None and len(inliers) > 3:
                agreed = inliers[:, 0]
                turn, move = cv2.solvePnPRefineLM(points.numpy()[agreed], frame[agreed], K.numpy(), None, turn, move)
            theirs.append((torch.from_numpy(cv2.Rodrigues(turn)[0]), torch.from_numpy(move[:, 0])))

    robust_pnp(points, pixels[:10], K)
    ours = robust_pnp(points, pixels, K)
    spent = min(seconds(lambda: robust_pnp(points, pixels, K)) for _ in range(3)), seconds(opencv)
    turned, moved = (torch.stack(part) for part in zip(*theirs, strict=True))
    rows = (
        ("torchface robust_pnp", spent[0], ours.pose.rotation, ours.pose.translation),
        ("cv2.solvePnPRansac + LM", spent[1], turned, moved),
    )
    print(f"\n{count} landmarks, 1 px of noise, 30 % of them up to 150 px off, {FRAMES} frames")
    print(f"{'':26} {'ms/frame':>9} {'degrees: median':>16} {'95 %':>7} {'over 10':>8} {'mm: median':>11}")
    for name, each, found, place in rows:
        angle, far = degrees(found, rotation), (place - translation).norm(dim=1).nan_to_num(1e9)
        print(
            f"{name:26} {1e3 * each / FRAMES:9.3f} {float(angle.median()):16.3f} {float(angle.quantile(0.95)):7.2f} "
            f"{float((angle > 10).double().mean()):8.1%} {float(far.median()):11.2f}"
        )
    angles = [degrees(found, rotation) for _, _, found, _ in rows]
    assert float(angles[0].median()) <= 1.02 * float(angles[1].median())
    assert float((angles[0] > 10).double().mean()) <= float((angles[1] > 10).double().mean())
    assert spent[0] < 3 * spent[1]


def test_poses_along_time() -> None:
    print(f"\n{'motion':>8} {'':12} {'jitter: rotation':>17} {'translation':>12} {'error: degrees':>15} {'mm':>6}")
    for size in (1.0, 0.2, 0.0):
        points, rotation, translation, pixels = filmed(1.5, size)
        raw = measure_poses(points, pixels, K)
        unfiltered = None
        for name, poses in (("unfiltered", raw), ("live", filter_poses(raw)), ("whole video", smooth_poses(raw))):
            turn = rotation_vector(poses.rotation @ rotation.transpose(1, 2))[20:]
            move = (poses.translation - translation)[20:]
            jitter = [float(each.diff(n=2, dim=0).square().mean().sqrt()) for each in (turn, move)]
            unfiltered = unfiltered or jitter
            error = float(turn.norm(dim=1).square().mean().sqrt().rad2deg()), float(move.square().sum(1).mean().sqrt())
            print(
                f"{size:8.1f} {name:12} {jitter[0] / unfiltered[0] - 1:17.1%} {jitter[1] / unfiltered[1] - 1:12.1%} "
                f"{error[0]:15.3f} {error[1]:6.2f}"
            )
            assert name != "live" or max(jitter[0] / unfiltered[0], jitter[1] / unfiltered[1]) < 0.4


def test_what_a_live_frame_costs() -> None:
    points, _, _, pixels = filmed(1.5)
    tracker, smoother = PoseTracker(points, K), LandmarkFilter()
    for frame in pixels[:50]:
        tracker.step(smoother.step(frame))
    pose = seconds(lambda: [tracker.step(frame) for frame in pixels[50:]]) / (FRAMES - 50)
    marks = seconds(lambda: [smoother.step(frame) for frame in pixels[50:]]) / (FRAMES - 50)
    print(f"\na live frame: head pose {1e3 * pose:.2f} ms, 68 landmarks filtered {1e3 * marks:.2f} ms")
    assert pose < 0.02
    assert marks < 0.01
