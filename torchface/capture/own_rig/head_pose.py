"""Where the head is in each frame: rotation and translation from the landmarks that expression hardly moves."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchface.capture.own_rig.pose_filter import PoseFilter, PoseFilterSettings, smooth_rigid_motion
from torchface.errors import AlignmentError, ShapeError, ValueRangeError
from torchface.geometry.cameras.pnp import Pose, pose_covariance
from torchface.geometry.cameras.robust_pnp import RobustPose, robust_pnp
from torchface.progress import Progress, silent

STABLE_LANDMARKS = (0, 1, 15, 16, 27, 28, 29, 30, 33, 36, 39, 42, 45)
"""Of the 68, those that expression moves by less than 1.2 mm, root mean square over 11,000 frames of real takes, on
ICT-FaceKit's head as well as on the embedded performer: temples, bridge and tip of the nose, septum, eye corners.
The next are nostrils, cheeks and brows with 1.3 to 2.5 mm; lips and chin move by up to 5.7 mm."""

# Temples are told from the background's edge, which slides along the head as it turns: they may be off twice as
# far as the others and count less, but nothing else tells so much of nodding.
_TRUST = torch.tensor([0.25 if i < 17 else 1.0 for i in STABLE_LANDMARKS], dtype=torch.float64)


@dataclass(frozen=True)
class PoseSettings:
    """How head poses are found and filtered.

    Args:
        threshold: how far a stable landmark may be off before it counts as an outlier, millimetres on the head; twice
            that for the temples. The rig is not the person to the millimetre, so this is more than landmarks are noisy.
        min_landmarks: stable landmarks that a pose needs.
        filter: what is reckoned with along time.
        seed: of the random draws.
    """

    threshold: float = 8.0
    min_landmarks: int = 6
    filter: PoseFilterSettings = field(default_factory=PoseFilterSettings)
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.threshold < float("inf") or self.min_landmarks < 4:
            raise ValueRangeError(
                f"pose: found threshold {self.threshold} and min_landmarks {self.min_landmarks}, expected positive "
                "millimetres and at least 4"
            )


@dataclass(frozen=True, eq=False)
class HeadPose:
    """Rig to camera in one frame, in OpenCV's convention.

    Args:
        rotation: (3,3); NaN where not found.
        translation: (3,), millimetres.
        error: of the stable landmarks beside the unfiltered pose, root mean square, pixels; NaN where not seen.
        found: whether there is a pose, seen or bridged.
    """

    rotation: Tensor
    translation: Tensor
    error: float
    found: bool


@dataclass(frozen=True, eq=False)
class HeadPoses:
    """Rig to camera in each frame, in OpenCV's convention.

    Args:
        rotation: (T,3,3) float64; NaN where not found.
        translation: (T,3), millimetres.
        errors: of the stable landmarks beside the unfiltered poses, weighted root mean square, (T,), pixels; NaN where
            not seen.
        found: frames with a pose, seen or bridged, (T,) bool.
        covariance: of the turn in the camera's frame (radians) and of the move (millimetres) of unfiltered poses, where
            a landmark is off by a pixel, (T,6,6); None once filtered.
    """

    rotation: Tensor
    translation: Tensor
    errors: Tensor
    found: Tensor
    covariance: Tensor | None = None


class PoseTracker:
    """Head poses frame by frame, from each frame and those before.

    Args:
        points: the 68 landmarks on the rig at rest, (68,3), millimetres.
        intrinsics: K, (3,3). Landmarks of a camera with distortion are undistorted first.
        settings: see :class:`PoseSettings`.

    Raises:
        ShapeError: points or intrinsics of another shape.

    Source: thesis 4.2.4 and 4.2.5.
    """

    def __init__(self, points: Tensor, intrinsics: Tensor, settings: PoseSettings | None = None) -> None:
        self.settings = settings or PoseSettings()
        self.points, self.intrinsics = _checked_points(points), intrinsics
        self._filter = PoseFilter(self.settings.filter)

    def step(self, landmarks: Tensor, confidence: Tensor | None = None) -> HeadPose:
        """The pose after a frame's landmarks (68,2), NaN for not seen; ``confidence`` (68,) from 0 weighs them.

        No gradients go through it.

        Raises:
            ShapeError: not 68 landmarks.
        """
        # Operations are many and small; what tensors keep for derivatives is a fifth of their cost.
        with torch.inference_mode():
            self._filter.to(landmarks.device).predict()
            before = self._filter.likeliest()
            start = Pose(before[0][None], before[1][None], before[1].new_zeros(1))
            weights = None if confidence is None else confidence[None]
            measured = _measured(self.points, landmarks[None], self.intrinsics, self.settings, weights, start)
            pose = _filtered_step(self._filter, measured, 0)
        # Copies, as autograd refuses tensors that were made without it.
        return replace(pose, rotation=pose.rotation.clone(), translation=pose.translation.clone())


def measure_poses(
    points: Tensor,
    landmarks: Tensor,
    intrinsics: Tensor,
    confidence: Tensor | None = None,
    settings: PoseSettings | None = None,
) -> HeadPoses:
    """The pose of each frame by itself, unfiltered, all frames at once.

    Args:
        points: the 68 landmarks on the rig at rest, (68,3), millimetres.
        landmarks: (T,68,2), pixels, NaN for not seen.
        intrinsics: K, (3,3).
        confidence: from 0, (T,68); equal if absent.
        settings: see :class:`PoseSettings`.

    Returns:
        ``HeadPoses`` with covariance. Frames with fewer than six stable landmarks that agree are not found.

    Raises:
        ShapeError: the shapes do not fit each other.
        AlignmentError: no frame has enough.

    Source: thesis 4.2.4.
    """
    poses = _measured(_checked_points(points), landmarks, intrinsics, settings or PoseSettings(), confidence, None)
    _check_found(poses, landmarks, settings or PoseSettings())
    return poses


def filter_poses(poses: HeadPoses, settings: PoseSettings | None = None) -> HeadPoses:
    """Unfiltered poses filtered causally: each from its frame and those before.

    Args:
        poses: what :func:`measure_poses` gave.
        settings: see :class:`PoseSettings`.

    Raises:
        ShapeError: the poses are filtered already.

    Source: thesis 4.2.5.
    """
    running = PoseFilter((settings or PoseSettings()).filter)
    steps = []
    for t in range(len(_with_covariance(poses).found)):  # a frame needs the one before
        running.predict()
        steps.append(_filtered_step(running, poses, t))
    return HeadPoses(
        torch.stack([step.rotation for step in steps]),
        torch.stack([step.translation for step in steps]),
        poses.errors,
        torch.tensor([step.found for step in steps], device=poses.errors.device),
    )


def smooth_poses(poses: HeadPoses, settings: PoseSettings | None = None) -> HeadPoses:
    """Unfiltered poses smoothed by all frames, those after each too, for work that need not be live.

    Args:
        poses: what :func:`measure_poses` gave.
        settings: see :class:`PoseSettings`; gaps up to ``longest_gap`` are bridged.

    Raises:
        ShapeError: the poses are filtered already.

    Source: Rauch, Tung, Striebel 1965; thesis 4.2.5.
    """
    covariance = _with_covariance(poses).covariance
    assert covariance is not None
    chosen = (settings or PoseSettings()).filter
    rotation, translation = smooth_rigid_motion(poses.rotation, poses.translation, covariance, chosen)
    return HeadPoses(rotation, translation, poses.errors, torch.isfinite(translation).all(1))


def track_pose(
    points: Tensor,
    landmarks: Tensor,
    intrinsics: Tensor,
    confidence: Tensor | None = None,
    settings: PoseSettings | None = None,
    progress: Progress | None = None,
) -> HeadPoses:
    """Head poses of a whole video, each from its frame and those before, as :class:`PoseTracker` gives them.

    Args:
        points: the 68 landmarks on the rig at rest, (68,3), millimetres.
        landmarks: (T,68,2), pixels, NaN for not seen; undistorted.
        intrinsics: K, (3,3).
        confidence: from 0, (T,68); equal if absent.
        settings: see :class:`PoseSettings`.
        progress: called with each step and how far it is.

    Returns:
        ``HeadPoses(rotation (T,3,3), translation (T,3), errors (T,), found (T,))``; gaps up to ``longest_gap`` frames
        are bridged, longer ones not found.

    Raises:
        ShapeError: the shapes do not fit each other.
        AlignmentError: no frame has six stable landmarks that agree.

    Source: thesis 4.2.4 and 4.2.5.
    """
    progress = progress or silent
    chosen = settings or PoseSettings()
    tracker, steps = PoseTracker(points, intrinsics, chosen), []
    _check_landmarks(landmarks, confidence)
    for t, frame in enumerate(landmarks):  # a frame's draws start from the pose before
        steps.append(tracker.step(frame, None if confidence is None else confidence[t]))
        progress("finding the head's pose", t + 1, len(landmarks))
    poses = HeadPoses(
        torch.stack([step.rotation for step in steps]),
        torch.stack([step.translation for step in steps]),
        torch.tensor([step.error for step in steps], dtype=torch.float64, device=landmarks.device),
        torch.tensor([step.found for step in steps], device=landmarks.device),
    )
    _check_found(poses, landmarks, chosen)
    return poses


def _measured(
    points: Tensor,
    landmarks: Tensor,
    intrinsics: Tensor,
    settings: PoseSettings,
    confidence: Tensor | None,
    start: Pose | None,
) -> HeadPoses:
    _check_landmarks(landmarks, confidence)
    stable = torch.tensor(STABLE_LANDMARKS, device=landmarks.device)
    x, q = points[stable], landmarks[:, stable].double()
    weights = _TRUST.to(q).expand(len(q), -1)
    if confidence is not None:
        weights = weights * confidence[:, stable].double().nan_to_num(0.0).clamp(min=0)
    found = robust_pnp(x, q, intrinsics, _limits(x, q, settings), weights, start, seed=settings.seed)
    return _judged(x, intrinsics, found, weights, settings)


def _judged(x: Tensor, intrinsics: Tensor, found: RobustPose, weights: Tensor, settings: PoseSettings) -> HeadPoses:
    """Poses that rest on enough landmarks, with their covariance."""
    enough = found.inliers.sum(1) >= settings.min_landmarks
    w = torch.where(found.inliers, weights, 0.0)
    rotation = torch.where(enough[:, None, None], found.pose.rotation, torch.nan)
    translation = torch.where(enough[:, None], found.pose.translation, torch.nan)
    covariance = translation.new_full((len(enough), 6, 6), torch.nan)
    covariance[enough] = pose_covariance(x, rotation[enough], translation[enough], intrinsics, w[enough])
    return HeadPoses(rotation, translation, torch.where(enough, found.pose.errors, torch.nan), enough, covariance)


def _limits(x: Tensor, q: Tensor, settings: PoseSettings) -> Tensor:
    """The threshold in pixels of each frame: millimetres times how large the head is seen, (T,)."""
    seen = torch.isfinite(q).all(-1)
    centre = torch.where(seen[..., None], q, torch.nan).nanmedian(1, keepdim=True).values
    # Medians, so that outliers do not make the head larger than it is.
    far = (q - centre).norm(dim=-1).nanmedian(1).values
    size = (x - x.median(0).values)[:, :2].norm(dim=-1).median()
    return (settings.threshold * far / size).nan_to_num(1.0).clamp(min=1.0)


def _filtered_step(running: PoseFilter, poses: HeadPoses, t: int) -> HeadPose:
    assert poses.covariance is not None
    running.correct(poses.rotation[t], poses.translation[t], poses.covariance[t])
    rotation, translation = running.pose()
    return HeadPose(rotation, translation, float(poses.errors[t]), bool(torch.isfinite(translation).all()))


def _with_covariance(poses: HeadPoses) -> HeadPoses:
    if poses.covariance is None:
        raise ShapeError("poses: found none with covariance, expected what measure_poses gave, not yet filtered")
    return poses


def _checked_points(points: Tensor) -> Tensor:
    if points.shape != (68, 3):
        raise ShapeError(f"points: found {tuple(points.shape)}, expected (68,3), the landmarks in iBUG's order")
    return points.detach().double()


def _check_landmarks(landmarks: Tensor, confidence: Tensor | None) -> None:
    if landmarks.ndim != 3 or landmarks.shape[1:] != (68, 2) or not len(landmarks):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (T,68,2) with a frame at least")
    if confidence is not None and confidence.shape != landmarks.shape[:2]:
        raise ShapeError(f"confidence: found {tuple(confidence.shape)}, expected {tuple(landmarks.shape[:2])}")


def _check_found(poses: HeadPoses, landmarks: Tensor, settings: PoseSettings) -> None:
    if not bool(poses.found.any()):
        seen = torch.isfinite(landmarks[:, list(STABLE_LANDMARKS)]).all(-1).sum(1)
        raise AlignmentError(
            f"head pose: found at most {int(seen.max())} of the {len(STABLE_LANDMARKS)} stable landmarks in any of "
            f"{len(seen)} frames, expected {settings.min_landmarks} that agree with one pose in some frame"
        )
