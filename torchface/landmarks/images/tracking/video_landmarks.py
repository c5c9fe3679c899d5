"""Landmarks of one face in all frames of a video, and how much they tremble."""

from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.io.video import VideoFile, open_video
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.tracking.landmark_tracker import LandmarkTracker
from torchface.progress import Progress, silent
from torchface.take import Track

LANDMARK_NAMES = tuple(str(number) for number in range(COUNT))
"""The channels of a track of landmarks: iBUG's numbers from 0."""


@contextmanager
def naming_the_frame(number: int) -> Iterator[None]:
    """Has errors of a step say which frame they are of, counted from 0."""
    try:
        yield
    except (ShapeError, ValueRangeError) as error:
        raise type(error)(f"frame {number}: {error}") from error


def track_landmarks(
    video: VideoFile | str | Path | Iterable[Tensor], tracker: LandmarkTracker, progress: Progress | None = None
) -> Track:
    """Landmarks of one face in all frames.

    Args:
        video: a file, or frames, uint8 (H,W) or (3,H,W) each.
        tracker: what finds them; it goes on from its last frame.
        progress: called with each step and how far it is.

    Returns:
        Names ``"0"`` to ``"67"``, values (T,68,2) in pixels, NaN where the face is lost, confidence (T,68).

    Raises:
        FileFormatError: the video cannot be decoded, changes size, or has a variable frame rate.
        ShapeError: frames of another kind.

    Example:
        >>> from torchface import zoo
        >>> blank = torch.full((120, 160), 128, dtype=torch.uint8)
        >>> track = track_landmarks([blank, blank], LandmarkTracker(zoo.get_model("face_landmarks")))
        >>> len(track.names), bool(track.values.isnan().all())
        (68, True)
    """
    progress = progress or silent
    if isinstance(video, str | Path):
        video = open_video(video)
    frames = video.color_frames() if isinstance(video, VideoFile) else video
    total = video.count if isinstance(video, VideoFile) else len(video) if isinstance(video, Sized) else 0
    readings: list[FaceReading] = []
    for frame in frames:  # a frame's box is the one before's
        with naming_the_frame(len(readings)):
            readings.append(tracker.step(frame))
        progress("tracking landmarks", len(readings), max(total, len(readings)) if total else 0)
    if not readings:
        return Track(LANDMARK_NAMES, torch.zeros(0, COUNT, 2), torch.zeros(0, COUNT))
    take = FaceReading.stacked(readings)
    return Track(LANDMARK_NAMES, take.landmarks, take.confidence)


def landmark_jitter(landmarks: Tensor) -> Tensor:
    r"""How much landmarks tremble, in pixels.

    .. math:: \sqrt{\tfrac16\, \operatorname{mean} (x_{t-1} - 2 x_t + x_{t+1})^2}

    over all coordinates: the standard deviation of white noise on a motion of constant velocity. What accelerates
    counts too: it is measured best on a still face.

    Args:
        landmarks: (T,L,2), pixels; NaN for not seen.

    Returns:
        A number; NaN where no landmark is seen in three frames in a row.

    Raises:
        ShapeError: not (T,L,2).

    Example:
        >>> steady = torch.arange(50.0)[:, None, None] * torch.ones(1, 68, 2)
        >>> landmark_jitter(steady).item()  # a constant speed is none
        0.0
    """
    if landmarks.ndim != 3 or landmarks.shape[2] != 2:
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (T,L,2)")
    second = (landmarks[2:] - 2 * landmarks[1:-1] + landmarks[:-2]).double()
    return (second.square().nanmean() / 6).sqrt()
