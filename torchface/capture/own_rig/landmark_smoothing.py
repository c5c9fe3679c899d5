"""Landmarks along time without jitter: live, frame by frame, or from the whole video."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from torchface.errors import ShapeError
from torchface.temporal import AdaptiveFilter, AdaptiveSettings, adaptive_filter, adaptive_smoother

# Pixels: landmarks of a face some 100 to 600 pixels high. Lids and lips move more abruptly than a head does.
LANDMARK_SETTINGS = AdaptiveSettings(measurement=(0.2, 0.6, 1.5, 4.0), jerk=(0.003, 0.01, 0.033, 0.11, 0.36, 1.2, 4.0))
"""What landmarks are filtered with by default."""


class LandmarkFilter:
    """Landmarks frame by frame, each from its frame and those before, as smooth as its own noise and motion ask for.

    Args:
        count: L.
        settings: noises and motions, pixels.

    Source: thesis 4.2.5.
    """

    def __init__(self, count: int = 68, settings: AdaptiveSettings = LANDMARK_SETTINGS) -> None:
        self._filter = AdaptiveFilter(count, 2, settings)

    def step(self, landmarks: Tensor) -> Tensor:
        """Filtered landmarks (L,2) after a frame's (L,2), pixels; NaN for not seen, and in gaps that are too long.

        Raises:
            ShapeError: another number of landmarks.
            ValueRangeError: an infinite one.
        """
        return self._filter.step(landmarks).to(landmarks.dtype)


def filter_landmarks(
    landmarks: Tensor, settings: AdaptiveSettings = LANDMARK_SETTINGS, intervals: Sequence[float] | None = None
) -> Tensor:
    """Landmarks (T,L,2) of a whole video, NaN for not seen, as :class:`LandmarkFilter` gives them.

    ``intervals`` are T, each from the frame before, in frames of the usual length; 1 if absent.

    Raises:
        ShapeError: landmarks of another shape.
        ValueRangeError: an infinite one.

    Source: thesis 4.2.5.
    """
    return adaptive_filter(_checked(landmarks), settings, intervals)


def smooth_landmarks(
    landmarks: Tensor, settings: AdaptiveSettings = LANDMARK_SETTINGS, intervals: Sequence[float] | None = None
) -> Tensor:
    """Landmarks (T,L,2) of a whole video from all frames, those after each too, for work that need not be live.

    Args:
        landmarks: pixels, NaN for not seen.
        settings: noises and motions, pixels; gaps up to ``longest_gap`` frames are bridged.
        intervals: from the frame before to each of T, in frames of the usual length; 1 if absent.

    Returns:
        Smoothed landmarks, (T,L,2); NaN in longer gaps and before a landmark was first seen.

    Raises:
        ShapeError: landmarks of another shape.
        ValueRangeError: an infinite one.

    Source: Rauch, Tung, Striebel 1965; thesis 4.2.5.
    """
    return adaptive_smoother(_checked(landmarks), settings, intervals)


def _checked(landmarks: Tensor) -> Tensor:
    if landmarks.ndim != 3 or landmarks.shape[2] != 2 or not len(landmarks):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (T,L,2) with a frame at least")
    return landmarks
