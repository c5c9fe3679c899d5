"""What time does to signals: smoothing and filtering along frames."""

from torchface.temporal.adaptive_kalman import AdaptiveFilter, AdaptiveSettings, adaptive_filter, adaptive_smoother
from torchface.temporal.interpolation import interpolated, nearest_rows
from torchface.temporal.kalman import KalmanFilter, KalmanSettings, estimate_settings, kalman_filter, kalman_smoother
from torchface.temporal.one_euro import OneEuroFilter, OneEuroSettings, one_euro_filter
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
    "estimate_settings",
    "interpolated",
    "kalman_filter",
    "kalman_smoother",
    "nearest_rows",
    "one_euro_filter",
    "savitzky_golay",
]
