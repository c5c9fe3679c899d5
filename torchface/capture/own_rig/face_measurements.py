"""Measurements of a face beside the pixels of its 68 landmarks: deviations, points of the surface, weights as read."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchface.capture.weight_readings import WeightReadings
from torchface.errors import ShapeError


@dataclass(frozen=True, eq=False)
class FaceMeasurements:
    """What is known of T frames beside where the 68 landmarks were found; each part may be absent.

    Args:
        deviation: what each of the 68 is expected to be off by, standard deviation of a coordinate, (T,68) pixels.
        points: P further points of the surface, (T,P,2) pixels, NaN for not seen; the solver knows where they lie.
        point_deviation: of these, (T,P) pixels.
        weights: linear readings of weights.

    Raises:
        ShapeError: points without their deviations, or of other frames.

    Example:
        >>> import torch
        >>> seen = FaceMeasurements(points=torch.zeros(3, 5, 2), point_deviation=torch.ones(3, 5))
        >>> seen.of_frames(torch.tensor([1])).points.shape
        torch.Size([1, 5, 2])
    """

    deviation: Tensor | None = None
    points: Tensor | None = None
    point_deviation: Tensor | None = None
    weights: WeightReadings | None = None

    def __post_init__(self) -> None:
        points = None if self.points is None else tuple(self.points.shape)
        deviation = None if self.point_deviation is None else tuple(self.point_deviation.shape)
        shaped = points is None or (len(points) == 3 and points[2] == 2)
        if not shaped or (points and points[:2]) != deviation:
            raise ShapeError(
                f"measurements: found points {points} of deviation {deviation}, expected (T,P,2) and (T,P)"
            )

    def of_frames(self, frames: Tensor) -> FaceMeasurements:
        """Those of some frames, (F,) int64."""
        deviation, points, of_points = (
            None if x is None else x[frames] for x in (self.deviation, self.points, self.point_deviation)
        )
        read = None if self.weights is None else self.weights.of_frames(frames)
        return FaceMeasurements(deviation, points, of_points, read)
