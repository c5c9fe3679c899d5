"""Measurements of a face beside the pixels of its 68 landmarks: deviations, weights as read, other cameras."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.capture.weight_readings import WeightReadings
from torchface.errors import ShapeError


@dataclass(frozen=True, eq=False)
class CameraView:
    """What another camera saw of T frames; poses are those of the first camera, so it says where it stands beside that.

    Args:
        landmarks: (T,68,2), pixels without distortion; NaN for not seen.
        deviation: what each is expected to be off by beside the solver's own noise, (T,68) pixels; infinite for not
            seen.
        intrinsics: K, (3,3), pixels.
        rotation, translation: first camera to this one, (3,3) and (3,), millimetres.

    Raises:
        ShapeError: an argument is not as above.

    Example:
        >>> marks, K = torch.rand(3, 68, 2), torch.tensor([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
        >>> view = CameraView(marks, torch.zeros(3, 68), K, torch.eye(3), torch.tensor([-60.0, 0, 0]))
        >>> view.pose(torch.eye(3)[None], torch.tensor([[0.0, 0, 500]]))[1].tolist()
        [[-60.0, 0.0, 500.0]]
    """

    landmarks: Tensor
    deviation: Tensor
    intrinsics: Tensor
    rotation: Tensor
    translation: Tensor

    def __post_init__(self) -> None:
        count = len(self.landmarks)
        shapes = {"landmarks": (count, 68, 2), "deviation": (count, 68), "intrinsics": (3, 3), "rotation": (3, 3)}
        for name, expected in {**shapes, "translation": (3,)}.items():
            if (found := tuple(getattr(self, name).shape)) != expected:
                raise ShapeError(f"camera view: found {name} {found}, expected {expected}")

    @property
    def seen(self) -> Tensor:
        """Which landmarks it saw, (T,68) bool."""
        return torch.isfinite(self.landmarks).all(-1) & torch.isfinite(self.deviation)

    def pose(self, rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (B,3,3) and (B,3) before the first camera as they are before this one."""
        R = self.rotation.to(rotation)
        return R @ rotation, translation @ R.T + self.translation.to(rotation)

    def pose_before_first(self, rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
        """The reverse of ``pose``."""
        R = self.rotation.to(rotation)
        return R.T @ rotation, (translation - self.translation.to(rotation)) @ R

    def of_frames(self, frames: Tensor) -> "CameraView":
        """That of some frames, (F,) int64."""
        return replace(self, landmarks=self.landmarks[frames], deviation=self.deviation[frames])


@dataclass(frozen=True, eq=False)
class FaceMeasurements:
    """What is known of T frames beside where the 68 landmarks were found; each part may be absent.

    Args:
        deviation: what each of the 68 is expected to be off by, standard deviation of a coordinate, (T,68) pixels.
        weights: linear readings of weights.
        views: of other cameras.

    Example:
        >>> import torch
        >>> FaceMeasurements(torch.ones(3, 68)).of_frames(torch.tensor([1])).deviation.shape
        torch.Size([1, 68])
    """

    deviation: Tensor | None = None
    weights: WeightReadings | None = None
    views: tuple[CameraView, ...] = ()

    def of_frames(self, frames: Tensor) -> "FaceMeasurements":
        """Those of some frames, (F,) int64."""
        deviation = None if self.deviation is None else self.deviation[frames]
        views = tuple(view.of_frames(frames) for view in self.views)
        return FaceMeasurements(deviation, None if self.weights is None else self.weights.of_frames(frames), views)
