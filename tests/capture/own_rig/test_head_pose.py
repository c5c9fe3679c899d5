"""Head poses along time: planted motion comes back with little jitter and no lag; gaps, outliers, real faces."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchface.capture.own_rig.head_pose import (
    STABLE_LANDMARKS,
    HeadPoses,
    PoseSettings,
    PoseTracker,
    filter_poses,
    measure_poses,
    smooth_poses,
    track_pose,
)
from torchface.capture.own_rig.pose_filter import PoseFilterSettings
from torchface.errors import AlignmentError, ShapeError, ValueRangeError
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.pnp import pixel_jacobian, solve_pnp
from torchface.geometry.rotations import rotation_matrix, rotation_vector
from torchface.io import load_rig, load_take
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping
from torchface.synthetic import neutral_head, performer

K = assumed_calibration(640, 480).intrinsics
UPRIGHT = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))


@functools.cache
def face() -> Tensor:
    mesh = neutral_head()
    return mesh.vertices[mesh.landmarks].double()


def motion(frames: int = 200, lively: float = 0.3) -> tuple[Tensor, Tensor]:
    """A head that turns by up to 35°, nods and moves, 30 frames a second: rotations and translations."""
    time = torch.arange(frames, dtype=torch.float64) / 30

    def swing(size: float, phase: float) -> Tensor:
        quick = lively * (2 * math.pi * 0.9 * time + 2 * phase).cos()
        return size * ((2 * math.pi * 0.4 * time + phase).sin() + quick)

    turns = torch.stack([swing(0.2, 0.3), swing(0.45, 1.0), swing(0.12, 2.0)], dim=1)
    moves = torch.stack([swing(40, 0.5), swing(20, 1.5), swing(50, 2.5)], dim=1)
    return UPRIGHT @ rotation_matrix(turns), moves + torch.tensor([0.0, 0, 600], dtype=torch.float64)


def seen(rotation: Tensor, translation: Tensor, noise: float = 1.5) -> Tensor:
    pixels, _ = pixel_jacobian(face() @ rotation.transpose(1, 2) + translation[:, None], K)
    generator = torch.Generator().manual_seed(1)
    return pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)


def jitter(rotation: Tensor, translation: Tensor, truth: tuple[Tensor, Tensor]) -> tuple[float, float]:
    """Second differences of what is wrong, radians and millimetres."""
    off = rotation_vector(rotation @ truth[0].transpose(1, 2))[20:], (translation - truth[1])[20:]
    return tuple(float(each.diff(n=2, dim=0).square().mean().sqrt()) for each in off)  # type: ignore[return-value]


def lag(values: Tensor, truth: Tensor) -> float:
    """Frames by which values trail the truth: where their mean squared distance is least, between frames too."""
    errors = [float((values[30:-6] - truth[30 - d : len(truth) - 6 - d]).square().mean()) for d in range(-5, 6)]
    best = min(range(1, 10), key=lambda i: errors[i])
    before, here, after = errors[best - 1 : best + 2]
    return best - 5 + 0.5 * (before - after) / (before - 2 * here + after)


def valid(poses: HeadPoses) -> bool:
    rotation = poses.rotation[poses.found]
    identity = torch.eye(3, dtype=torch.float64).expand(len(rotation), 3, 3)
    upright = bool((torch.linalg.det(rotation) > 0.999).all())
    return upright and torch.allclose(rotation @ rotation.transpose(1, 2), identity, atol=1e-10)


def test_jitter_falls_by_three_fifths_without_a_frame_of_lag() -> None:
    truth = motion()
    raw = measure_poses(face(), seen(*truth), K)
    filtered, smoothed = filter_poses(raw), smooth_poses(raw)
    before, live, whole = (jitter(p.rotation, p.translation, truth) for p in (raw, filtered, smoothed))
    assert live[0] < 0.4 * before[0]
    assert live[1] < 0.4 * before[1]
    assert whole[0] < 0.05 * before[0]
    assert whole[1] < 0.05 * before[1]
    for poses, most in ((filtered, 0.3), (smoothed, 0.1)):
        assert valid(poses)
        assert abs(lag(rotation_vector(UPRIGHT @ poses.rotation), rotation_vector(UPRIGHT @ truth[0]))) < most
        assert abs(lag(poses.translation, truth[1])) < most
    errors = [(p.translation - truth[1])[20:].square().mean() for p in (raw, filtered, smoothed)]
    assert errors[2] < 0.3 * errors[1] < 0.3 * errors[0]


def test_a_head_that_is_still_is_smoothed_most() -> None:
    rotation, translation = (each[:1].expand(120, *each.shape[1:]) for each in motion())
    raw = measure_poses(face(), seen(rotation, translation), K)
    filtered = filter_poses(raw)
    before = jitter(raw.rotation, raw.translation, (rotation, translation))
    live = jitter(filtered.rotation, filtered.translation, (rotation, translation))
    assert live[0] < 0.15 * before[0]
    assert live[1] < 0.15 * before[1]


def test_frame_by_frame_through_outliers_and_gaps() -> None:
    truth = motion(150, 0.1)
    landmarks = seen(*truth, noise=0.7)
    generator = torch.Generator().manual_seed(2)
    wrong = torch.rand(landmarks.shape[:2], generator=generator) < 0.25
    landmarks = torch.where(wrong[..., None], landmarks + 60, landmarks)
    landmarks[60:66], landmarks[90:120] = torch.nan, torch.nan
    chosen = PoseSettings(filter=PoseFilterSettings(longest_gap=8))
    poses = track_pose(face(), landmarks, K, settings=chosen)
    assert poses.found.tolist() == [True] * 98 + [False] * 22 + [True] * 30
    assert poses.rotation[98:120].isnan().all()
    assert poses.errors.isfinite().sum() > 110
    assert valid(poses)
    off = rotation_vector(poses.rotation @ truth[0].transpose(1, 2)).norm(dim=1).rad2deg()
    assert float(off[20:60].mean()) < 1
    assert float(off[60:66].max()) < 8
    smoothed = smooth_poses(measure_poses(face(), landmarks, K, settings=chosen), chosen)
    assert torch.equal(smoothed.found, torch.arange(150).lt(90) | torch.arange(150).ge(120))
    assert valid(smoothed)
    off = rotation_vector(smoothed.rotation @ truth[0].transpose(1, 2)).norm(dim=1).rad2deg()
    assert float(off[60:66].max()) < 3


def test_whole_turns_have_no_sign_to_mind() -> None:
    # A head that turns about the vertical past half a turn: a quaternion's sign would flip on the way.
    angle = torch.linspace(2.2, 4.2, 90, dtype=torch.float64)
    rotation = rotation_matrix(angle[:, None] * torch.tensor([0.0, 0, 1], dtype=torch.float64)) @ UPRIGHT
    translation = torch.tensor([0.0, 0, 600], dtype=torch.float64).expand(90, 3)
    raw = measure_poses(face(), seen(rotation, translation, 1.0), K)
    for poses in (filter_poses(raw), smooth_poses(raw)):
        assert valid(poses)
        off = rotation_vector(poses.rotation @ rotation.transpose(1, 2)).norm(dim=1).rad2deg()
        assert float(off[10:].max()) < 3


def test_a_head_found_elsewhere_is_begun_anew() -> None:
    truth = motion(40, 0.0)
    landmarks = seen(*truth, noise=0.3)
    landmarks[20:] += 150.0
    landmarks[10] += 150.0  # a single frame of another face is passed over
    poses = track_pose(face(), landmarks, K)
    assert float((poses.translation[10] - truth[1][10]).norm()) < 10
    assert float((poses.translation[30:] - truth[1][30:])[:, :2].norm(dim=1).min()) > 100
    alone = track_pose(face(), landmarks[30:], K)
    assert float((poses.translation[35:] - alone.translation[5:]).norm(dim=1).max()) < 5


@settings(max_examples=6)
@given(st.integers(0, 10**6), st.floats(0, 0.7))
def test_any_pattern_of_landmarks_not_seen(seed: int, share: float) -> None:
    landmarks = seen(*motion(12))
    unseen = torch.rand(12, 68, generator=torch.Generator().manual_seed(seed)) < share
    landmarks[unseen] = torch.nan
    stable = (~unseen[:, list(STABLE_LANDMARKS)]).sum(1)
    if int(stable.max()) < 6:
        with pytest.raises(AlignmentError):
            measure_poses(face(), landmarks, K)
        return
    poses = track_pose(face(), landmarks, K)
    first = int((stable >= 6).nonzero()[0])
    assert not poses.found[:first].any()
    assert valid(poses)
    assert torch.equal(poses.errors.isfinite() & (stable < 6), torch.zeros(12, dtype=torch.bool))


def test_temples_that_are_off_do_not_make_poses_jump() -> None:
    # Detectors put the temples of real faces centimetres off, on one side more than on the other.
    truth = motion(60, 0.0)
    landmarks = seen(*truth, noise=0.7)
    biased = landmarks.clone()
    biased[:, [0, 1], 0] -= 12.0
    shaky, steady = (measure_poses(face(), each, K) for each in (biased, landmarks))
    turning = [rotation_vector(each.rotation @ truth[0].transpose(1, 2)) for each in (shaky, steady)]
    jumps = [float(each.diff(n=2, dim=0).norm(dim=1).max().rad2deg()) for each in turning]
    assert jumps[0] < 1.5 * jumps[1]
    assert float(turning[0].norm(dim=1).rad2deg().mean()) < 6


def test_confidence_tells_whom_to_believe() -> None:
    truth = motion(3)
    landmarks = seen(*truth, noise=0.0)
    landmarks[:, [0, 1, 15, 16]] += 6.0
    confidence = torch.ones(3, 68)
    confidence[:, [0, 1, 15, 16]] = 0.0
    off = [
        rotation_vector(measure_poses(face(), landmarks, K, each).rotation @ truth[0].transpose(1, 2)).norm(dim=1).max()
        for each in (confidence, None)
    ]
    assert off[0] < 1e-5 < off[1]


def test_bad_input_is_named() -> None:
    landmarks = seen(*motion(3))
    with pytest.raises(ShapeError, match=r"points: found \(67, 3\)"):
        PoseTracker(face()[1:], K)
    with pytest.raises(ShapeError, match=r"landmarks: found \(3, 67, 2\)"):
        track_pose(face(), landmarks[:, 1:], K)
    with pytest.raises(ShapeError, match=r"confidence: found \(2, 68\)"):
        measure_poses(face(), landmarks, K, torch.ones(2, 68))
    landmarks[:, list(STABLE_LANDMARKS[:8])] = torch.nan
    with pytest.raises(AlignmentError, match="at most 5 of the 13 stable landmarks in any of 3 frames, expected 6"):
        track_pose(face(), landmarks, K)
    with pytest.raises(ShapeError, match="not yet filtered"):
        smooth_poses(track_pose(face(), seen(*motion(3)), K))
    with pytest.raises(ValueRangeError, match="noise"):
        PoseFilterSettings(noise=())
    with pytest.raises(ValueRangeError, match="fading 2"):
        PoseFilterSettings(fading=2.0)
    with pytest.raises(ValueRangeError, match="at least 4"):
        PoseSettings(min_landmarks=3)


@pytest.mark.real
def test_expression_hardly_moves_the_stable_landmarks(
    real_capture: tuple[BlendshapeRig, object, list[Tensor]], performances: list[Path]
) -> None:
    rigs = [real_capture[0], performer()]
    tracks = [load_take(path).weights for path in performances]
    moves = []
    for rig in rigs:
        annotations = rig.neutral.annotations
        assert annotations is not None
        assert annotations.landmarks is not None
        weights = torch.cat([(t.values[..., 0] @ mapping(t.names, rig.names).T).clamp(0, 1) for t in tracks if t])
        away = torch.einsum("tn,nlc->tlc", weights, rig.deltas[:, annotations.landmarks])
        moves.append(away.square().sum(-1).mean(0).sqrt())
    most = torch.stack(moves).amax(0)
    others = [i for i in range(68) if i not in STABLE_LANDMARKS]
    assert float(most[list(STABLE_LANDMARKS)].max()) < 1.2
    assert float(most[others].min()) > 1.2


@pytest.mark.real
def test_expression_hardly_turns_the_head(
    real_capture: tuple[BlendshapeRig, object, list[Tensor]], performances: list[Path]
) -> None:
    rig, _, weights = real_capture
    ids = rig.neutral.landmarks
    points = rig.vertices[ids].double()
    speaking = points + torch.einsum("tn,nlc->tlc", weights[2][::15].double(), rig.deltas[:, ids].double())
    rotation = UPRIGHT @ rotation_matrix(torch.tensor([0.1, 0.3, 0.05]).double())
    pixels, _ = pixel_jacobian(speaking @ rotation.T + torch.tensor([0.0, 0, 550]).double(), K)

    def off(found: Tensor) -> float:
        return float(rotation_vector(found @ rotation.T).norm(dim=1).rad2deg().mean())

    assert off(measure_poses(points, pixels, K).rotation) < 0.4
    assert off(solve_pnp(points, pixels, K).rotation) > 1.0


@pytest.mark.real
def test_as_openface_on_a_real_face(ict_folder: Path, data: Path) -> None:
    rig = load_rig(ict_folder, part="face")
    annotations = rig.neutral.annotations
    assert annotations is not None
    assert annotations.landmarks is not None
    points = rig.neutral.vertices[annotations.landmarks]
    take = load_take(data / "landmarks" / "openface_100_frames.csv")
    assert take.landmarks is not None
    columns = take.extras["columns"]
    theirs = torch.stack([columns[f"pose_R{axis}"] for axis in "xyz"], dim=1)
    landmarks = take.landmarks.values.double()
    # The video is 640 x 360; the head turns by no more than 0.7 degrees, root mean square, in these frames.
    raw = measure_poses(points, landmarks, assumed_calibration(640, 360).intrinsics)
    assert raw.found.all()
    assert float(raw.errors.mean()) < 1.0
    for poses, like, most in ((raw, 0.9, 0.3), (filter_poses(raw), 0.85, 0.35)):
        angles = torch.from_numpy(Rotation.from_matrix((poses.rotation @ UPRIGHT).numpy()).as_euler("XYZ"))
        for ours, openface in zip(angles[10:].T, theirs[10:].T, strict=True):
            assert float(torch.corrcoef(torch.stack([ours, openface]))[0, 1]) > like
            assert float((ours - openface).std().rad2deg()) < most
