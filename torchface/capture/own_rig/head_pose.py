"""Head poses of frames from the landmarks that expression hardly moves."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError
from torchface.geometry.cameras.robust_pnp import robust_pnp

STABLE_LANDMARKS = (0, 1, 15, 16, 27, 28, 29, 30, 33, 36, 39, 42, 45)
"""Of the 68, those that expression moves by less than 1.2 mm, root mean square over 11,000 frames of real takes, on
ICT-FaceKit's head as well as on the embedded performer: temples, bridge and tip of the nose, septum, eye corners.
The next are nostrils, cheeks and brows with 1.3 to 2.5 mm; lips and chin move by up to 5.7 mm."""

# Detectors see temples by the edge of the background, which slides along the head as it turns. They may be off twice as
# far as the others and count less, but no other landmarks show nodding as well.
_TRUST = torch.tensor([0.25 if i < 17 else 1.0 for i in STABLE_LANDMARKS], dtype=torch.float64)


# How far a stable landmark may be off before it counts as an outlier, millimetres on the head; twice that for the
# temples. The rig is not the person to the millimetre, so this is more than landmarks are noisy.
_THRESHOLD = 8.0
_MIN_LANDMARKS = 6  # stable landmarks that a pose needs


@dataclass(frozen=True, eq=False)
class HeadPoses:
    """Rig to camera in each frame, in OpenCV's convention."""

    rotation: Tensor  # (T,3,3) float64; NaN where not found
    translation: Tensor  # (T,3), millimetres
    errors: Tensor  # of the stable landmarks, weighted root mean square, (T,), pixels; NaN where not found
    found: Tensor  # frames with a pose, (T,) bool


def measure_poses(points: Tensor, landmarks: Tensor, intrinsics: Tensor, confidence: Tensor | None = None) -> HeadPoses:
    """The pose of each frame by itself; frames with fewer than six stable landmarks that agree are not found.

    Args:
        points: the 68 landmarks on the rig at rest, (68,3), millimetres.
        landmarks: (T,68,2), pixels, NaN for not seen; undistorted.

    Source: thesis 4.2.4.
    """
    _check_shapes(points, landmarks, confidence)
    stable = torch.tensor(STABLE_LANDMARKS, device=landmarks.device)
    x, q = points.detach().double()[stable], landmarks[:, stable].double()
    weights = _TRUST.to(q).expand(len(q), -1)
    if confidence is not None:
        weights = weights * confidence[:, stable].double().nan_to_num(0.0).clamp(min=0)
    seen = robust_pnp(x, q, intrinsics, _limits(x, q), weights)
    found = seen.inliers.sum(1) >= _MIN_LANDMARKS
    if not bool(found.any()):
        most = int(torch.isfinite(q).all(-1).sum(1).max())
        raise AlignmentError(
            f"head pose: found at most {most} of the {len(STABLE_LANDMARKS)} stable landmarks in any of {len(q)} "
            f"frames, expected {_MIN_LANDMARKS} that agree with one pose in some frame"
        )
    return HeadPoses(
        torch.where(found[:, None, None], seen.pose.rotation, torch.nan),
        torch.where(found[:, None], seen.pose.translation, torch.nan),
        torch.where(found, seen.pose.errors, torch.nan),
        found,
    )


def _limits(x: Tensor, q: Tensor) -> Tensor:
    """The threshold in pixels of each frame: millimetres times how large the head is seen, (T,)."""
    seen = torch.isfinite(q).all(-1)
    centre = torch.where(seen[..., None], q, torch.nan).nanmedian(1, keepdim=True).values
    # Medians, so that outliers do not make the head larger than it is.
    far = (q - centre).norm(dim=-1).nanmedian(1).values
    size = (x - x.median(0).values)[:, :2].norm(dim=-1).median()
    return (_THRESHOLD * far / size).nan_to_num(1.0).clamp(min=1.0)


def _check_shapes(points: Tensor, landmarks: Tensor, confidence: Tensor | None) -> None:
    if points.shape != (68, 3):
        raise ShapeError(f"points: found {tuple(points.shape)}, expected (68,3), the landmarks in iBUG's order")
    if landmarks.ndim != 3 or landmarks.shape[1:] != (68, 2) or not len(landmarks):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (T,68,2) with a frame at least")
    if confidence is not None and confidence.shape != landmarks.shape[:2]:
        raise ShapeError(f"confidence: found {tuple(confidence.shape)}, expected {tuple(landmarks.shape[:2])}")
