"""Smoothing and filtering of signals along frames."""

from torchface.temporal.adaptive_kalman import AdaptiveFilter, AdaptiveSettings, adaptive_filter, adaptive_smoother
from torchface.temporal.interpolation import interpolated, nearest_rows
from torchface.temporal.kalman import KalmanFilter, KalmanSettings, kalman_smoother
from torchface.temporal.one_euro import OneEuroFilter, OneEuroSettings
from torchface.temporal.savitzky_golay import savitzky_golay

__all__ = [
    "AdaptiveFilter",
    "AdaptiveSettings",
    "KalmanFilter",
    "KalmanSettings",
    "OneEuroFilter",
    "OneEuroSettings",
    "adaptive_filter",
    "adaptive_smoother",
    "interpolated",
    "kalman_smoother",
    "nearest_rows",
    "savitzky_golay",
]
