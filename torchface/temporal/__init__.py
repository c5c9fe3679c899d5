"""Smoothing and filtering of signals along frames."""

from torchface.temporal.interpolation import interpolated, nearest_rows
from torchface.temporal.one_euro import OneEuroFilter, OneEuroSettings
from torchface.temporal.savitzky_golay import savitzky_golay

__all__ = [
    "OneEuroFilter",
    "OneEuroSettings",
    "interpolated",
    "nearest_rows",
    "savitzky_golay",
]
