"""What time does to signals: smoothing and filtering along frames."""

from torchface.temporal.smoothing import savitzky_golay

__all__ = ["savitzky_golay"]
