"""Measurements of a face beside the pixels of its 68 landmarks: their deviations, and weights as read."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchface.capture.weight_readings import WeightReadings


@dataclass(frozen=True, eq=False)
class FaceMeasurements:
    """What is known of T frames beside where the 68 landmarks were found; each part may be absent.

    Args:
        deviation: what each of the 68 is expected to be off by, standard deviation of a coordinate, (T,68) pixels.
        weights: linear readings of weights.

    Example:
        >>> import torch
        >>> FaceMeasurements(torch.ones(3, 68)).of_frames(torch.tensor([1])).deviation.shape
        torch.Size([1, 68])
    """

    deviation: Tensor | None = None
    weights: WeightReadings | None = None

    def of_frames(self, frames: Tensor) -> FaceMeasurements:
        """Those of some frames, (F,) int64."""
        deviation = None if self.deviation is None else self.deviation[frames]
        return FaceMeasurements(deviation, None if self.weights is None else self.weights.of_frames(frames))
