"""Head pose beside OpenCV's RANSACs, many frames at once and one at a time, with and without outliers on the temples;
and what filtering live costs and gains. One thread, processor time."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchface.capture.own_rig.head_pose import STABLE_LANDMARKS
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.pnp import pixel_jacobian, solve_pnp
from torchface.geometry.cameras.robust_pnp import robust_pnp
from torchface.geometry.rotations import rotation_matrix, rotation_vector
from torchface.synthetic import neutral_head

K = assumed_calibration(640, 480).intrinsics
UPRIGHT = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
FRAMES, FEW = 300, 60
pytestmark = pytest.mark.usefixtures("one_thread")


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


def turned_far(flatness: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What ``filmed`` gives, with the stable landmarks alone, of a head in any pose up to 86° from the camera."""
    generator = torch.Generator().manual_seed(0)
    mesh = neutral_head()
    points = mesh.vertices[mesh.landmarks].double()[list(STABLE_LANDMARKS)]
    points = points * torch.tensor([1.0, 1.0, flatness], dtype=torch.float64)
    angles = (torch.rand(FRAMES, 3, generator=generator).double() - 0.5) * torch.tensor([1.5, 3.0, 1.5]).double()
    rotation = UPRIGHT @ torch.from_numpy(Rotation.from_euler("xyz", angles.numpy()).as_matrix())
    translation = (torch.rand(FRAMES, 3, generator=generator).double() - 0.5) * torch.tensor([200.0, 200, 600]).double()
    translation = translation + torch.tensor([0.0, 0, 750], dtype=torch.float64)
    pixels, _ = pixel_jacobian(points @ rotation.transpose(1, 2) + translation[:, None], K)
    return points, rotation, translation, pixels + torch.randn(pixels.shape, generator=generator).double()


@dataclass(frozen=True)
class Ransac:
    """Settings of ``cv2.solvePnPRansac``; what it finds is refined on its inliers by Levenberg's method."""

    method: int
    draws: int
    confidence: float

    def poses(self, points: Tensor, pixels: Tensor, threshold: float = 4.0) -> "Found":
        """Of each frame, and its inliers; OpenCV takes one view at a time, and weighs all points alike."""
        model, camera = points.numpy(), K.numpy()
        turns, moves, agreed = [], [], torch.zeros(pixels.shape[:2], dtype=torch.bool)
        for row, frame in enumerate(pixels.numpy()):
            good, vector, move, inliers = cv2.solvePnPRansac(
                model,
                frame,
                camera,
                None,
                iterationsCount=self.draws,
                reprojectionError=threshold,
                confidence=self.confidence,
                flags=self.method,
            )
            if good and inliers is not None and len(inliers) > 3:
                kept = inliers[:, 0]
                vector, move = cv2.solvePnPRefineLM(model[kept], frame[kept], camera, None, vector, move)
                agreed[row, kept] = True
            elif not good:
                vector, move = np.full((2, 3, 1), np.nan)
            turns.append(vector[:, 0])
            moves.append(move[:, 0])
        rotation = rotation_matrix(torch.from_numpy(np.stack(turns)))
        return Found(rotation, torch.from_numpy(np.stack(moves)), agreed)


@dataclass(frozen=True, eq=False)
class Found:
    """Rotations (B,3,3), translations (B,3), inliers (B,N)."""

    rotation: Tensor
    translation: Tensor
    inliers: Tensor


PEERS = {
    "cv2 default (EPnP)": Ransac(cv2.SOLVEPNP_ITERATIVE, 256, 0.99),
    "cv2 SQPnP": Ransac(cv2.SOLVEPNP_SQPNP, 300, 0.99),
    "cv2 AP3P": Ransac(cv2.SOLVEPNP_AP3P, 300, 0.99),
    "cv2 AP3P, 4,000 draws": Ransac(cv2.SOLVEPNP_AP3P, 4000, 1 - 1e-9),
    "cv2 USAC_ACCURATE": Ransac(cv2.USAC_ACCURATE, 1000, 0.9999),
}


@dataclass(frozen=True)
class Row:
    """Processor milliseconds a frame, degrees off in the median and at 95 %, share over 10°, millimetres."""

    milliseconds: float
    median: float
    tail: float
    wrong: float
    far: float

    @staticmethod
    def of(spent: float, found: Found, rotation: Tensor, translation: Tensor) -> "Row":
        angle = degrees(found.rotation, rotation)
        far = (found.translation - translation).norm(dim=1).nan_to_num(1e9)
        wrong = float((angle > 10).double().mean())
        return Row(
            1e3 * spent / len(angle), float(angle.median()), float(angle.quantile(0.95)), wrong, float(far.median())
        )


def timed(solve: Callable[[], Found], passes: int = 2) -> tuple[Found, float]:
    """What is found, and the seconds of the quicker pass: others share the machine."""
    best = math.inf
    for _ in range(passes):
        begin = time.process_time()
        found = solve()
        best = min(best, time.process_time() - begin)
    return found, best


def show(title: str, rows: dict[str, Row]) -> None:
    print(f"{title}\n{'':36} {'ms/frame':>9} {'degrees: median':>16} {'95 %':>7} {'over 10':>8} {'mm: median':>11}")
    for name, row in rows.items():
        print(f"{name:36} {row.milliseconds:9.3f} {row.median:16.3f} {row.tail:7.2f} {row.wrong:8.1%} {row.far:11.2f}")


def robust(points: Tensor, pixels: Tensor, **settings: float | Tensor) -> Found:
    found = robust_pnp(points, pixels, K, **settings)
    return Found(found.pose.rotation, found.pose.translation, found.inliers)


def spoiled(pixels: Tensor, share: float = 0.3) -> Tensor:
    """Pixels of which a share is up to 150 pixels off."""
    generator = torch.Generator().manual_seed(2)
    wrong = torch.rand(pixels.shape[:2], generator=generator) < share
    residual = 300 * (torch.rand(pixels.shape, generator=generator).double() - 0.5)
    return torch.where(wrong[..., None], pixels + residual, pixels)


@pytest.mark.parametrize("scene", ["68 landmarks", "13 landmarks", "13, any pose", "13, any pose, flat face"])
def test_many_frames_at_once_beside_opencv(scene: str, print_machine: Callable[..., None]) -> None:
    if "any" in scene:
        points, rotation, translation, pixels = turned_far(0.15 if "flat" in scene else 1.0)
    else:
        points, rotation, translation, pixels = filmed(1.0)
    if scene == "13 landmarks":
        points, pixels = points[list(STABLE_LANDMARKS)], pixels[:, list(STABLE_LANDMARKS)]
    pixels = spoiled(pixels)
    robust(points, pixels[:10])
    found, spent = timed(lambda: robust(points, pixels))
    rows = {"torchface, all frames at once": Row.of(spent, found, rotation, translation)}
    for name, peer in PEERS.items():
        found, spent = timed(lambda peer=peer: peer.poses(points, pixels))
        rows[f"{name}, refined"] = Row.of(spent, found, rotation, translation)
    print_machine("opencv-contrib-python-headless")
    show(f"{scene}, 1 px of noise, 30 % of them up to 150 px wrong, {FRAMES} frames", rows)
    ours, alike = rows["torchface, all frames at once"], rows["cv2 AP3P, 4,000 draws, refined"]
    for name, row in rows.items():
        if "4,000" not in name and "USAC" not in name:
            assert ours.median <= row.median
            assert ours.wrong <= row.wrong
    assert ours.milliseconds < 1.5 * alike.milliseconds


def test_one_frame_at_a_time_beside_opencv(print_machine: Callable[..., None]) -> None:
    """Thirteen landmarks. torchface refines what OpenCV's AP3P finds with 4,000 draws."""
    stable = list(STABLE_LANDMARKS)
    points, rotation, translation, clean = filmed(1.0)
    points, clean = points[stable], clean[:, stable]
    for scene, pixels in (("no outliers", clean), ("30 % up to 150 px wrong", spoiled(clean))):

        def alone(pixels: Tensor = pixels) -> Found:
            with torch.inference_mode():
                return joined([robust(points, frame[None]) for frame in pixels[:FEW]])

        found, spent = timed(alone)
        rows = {"torchface": Row.of(spent, found, rotation[:FEW], translation[:FEW])}
        for name, peer in PEERS.items():
            found, spent = timed(lambda peer=peer, pixels=pixels: peer.poses(points, pixels))
            rows[f"{name}, refined"] = Row.of(spent, found, rotation, translation)
        print_machine("opencv-contrib-python-headless")
        show(f"one frame at a time, 13 landmarks, 1 px of noise, {scene}", rows)
        assert rows["torchface"].wrong <= rows["cv2 AP3P, refined"].wrong


def joined(frames: list[Found]) -> Found:
    return Found(
        *(torch.cat([getattr(each, name) for each in frames]) for name in ("rotation", "translation", "inliers"))
    )


def test_temples_that_are_off_beside_opencv(print_machine: Callable[..., None]) -> None:
    """What weights are worth: temples 12 pixels off on one side, as detectors put them, must not make poses jump.

    They are the least exact of the thirteen landmarks, and tell most of nodding. Nobody finds the bias itself: the mean
    error is about the same with weights and without.
    """
    stable = list(STABLE_LANDMARKS)
    points, rotation, _, pixels = filmed(0.7)
    points, steady, shaky = points[stable], pixels[:, stable], pixels[:, stable].clone()
    shaky[:, :2, 0] -= 12.0
    trust = torch.where(torch.tensor(stable) < 17, 0.25, 1.0).double()
    inner = [row for row, landmark in enumerate(stable) if landmark > 16]
    threshold = 8.0 * float(K[0, 0]) / 600

    def refined(found: Found, seen: Tensor) -> Found:
        pose = solve_pnp(points, seen, K, trust * found.inliers)
        return Found(pose.rotation, pose.translation, found.inliers)

    many = PEERS["cv2 AP3P, 4,000 draws"]
    ways: dict[str, Callable[[Tensor], Found]] = {
        "torchface, temples weigh 1/4": lambda q: robust(points, q, threshold=threshold, weights=trust),
        "torchface, no weights": lambda q: robust(points, q, threshold=threshold),
        "torchface, without temples": lambda q: robust(points[inner], q[:, inner], threshold=threshold),
        "AP3P, 4,000 draws, weighted refined": lambda q: refined(many.poses(points, q, threshold), q),
        "AP3P, 4,000 draws, without temples": lambda q: many.poses(points[inner], q[:, inner], threshold),
    }
    for name, peer in PEERS.items():
        ways[name] = lambda q, peer=peer: peer.poses(points, q, threshold)
    print_machine("opencv-contrib-python-headless")
    print(f"13 landmarks, 0.7 px of noise, two temples 12 px off on one side, {FRAMES} frames; degrees")
    print(f"{'':36} {'ms/frame':>9} {'jump: most':>11} {'if steady':>10} {'error: mean':>12} {'if steady':>10}")
    jumps, errors = {}, {}
    for name, way in ways.items():
        found, spent = timed(lambda way=way: way(shaky), 1)
        turns = [rotation_vector(each.rotation @ rotation.transpose(1, 2)) for each in (found, way(steady))]
        jumps[name] = [float(turn.diff(n=2, dim=0).norm(dim=1).max().rad2deg()) for turn in turns]
        errors[name] = [float(turn.norm(dim=1).mean().rad2deg()) for turn in turns]
        print(
            f"{name:36} {1e3 * spent / FRAMES:9.3f} {jumps[name][0]:11.2f} {jumps[name][1]:10.2f} "
            f"{errors[name][0]:12.2f} {errors[name][1]:10.2f}",
            flush=True,
        )
    ours = "torchface, temples weigh 1/4"
    assert all(jumps[ours][0] < jumps[name][0] for name in PEERS)
    assert jumps[ours][0] < 1.05 * jumps[ours][1]
