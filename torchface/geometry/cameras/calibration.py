"""The intrinsics of a camera: focal length, centre and lens distortion at one resolution."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError

__all__ = ["CameraCalibration", "PlacedCamera", "assumed_calibration"]

ASSUMED_FIELD_OF_VIEW = 60.0
"""Degrees across the longer side: what webcams and phones have, near enough, where nothing is known."""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A camera's own parameters, OpenCV's model; pixel centres lie at integers.

    Args:
        intrinsics: K, (3,3), pixels.
        distortion: k1, k2, p1, p2, k3 of radial and tangential distortion, (5,); zeros for a lens without.
        width, height: of the images that it holds for, pixels.
        error: reprojection, root mean square, pixels; None where the camera was not measured but assumed.
        guessed: whether the focal length was estimated with a head that was not known, and is rough.

    Raises:
        ShapeError: intrinsics or distortion of another shape.
        ValueRangeError: no pinhole camera, or numbers that are not finite.
    """

    intrinsics: Tensor
    distortion: Tensor
    width: int
    height: int
    error: float | None = None
    guessed: bool = False

    def __post_init__(self) -> None:
        if self.intrinsics.shape != (3, 3) or self.distortion.shape != (5,):
            raise ShapeError(
                f"calibration: found intrinsics {tuple(self.intrinsics.shape)} and distortion "
                f"{tuple(self.distortion.shape)}, expected (3,3) and (5,)"
            )
        if self.width < 1 or self.height < 1:
            raise ValueRangeError(f"calibration: found {self.width} x {self.height} pixels, expected positive numbers")
        if not torch.isfinite(self.intrinsics).all() or not torch.isfinite(self.distortion).all():
            raise ValueRangeError("calibration: found NaN or infinity, expected finite numbers")
        if (self.intrinsics.diagonal()[:2] <= 0).any() or self.intrinsics[2].tolist() != [0, 0, 1]:
            raise ValueRangeError(
                f"intrinsics: found {self.intrinsics.tolist()}, expected positive focal lengths and a last row 0 0 1"
            )
        if self.error is not None and not (math.isfinite(self.error) and self.error >= 0):
            raise ValueRangeError(f"error: found {self.error}, expected pixels from 0, or None for an assumed camera")

    @property
    def assumed(self) -> bool:
        """Whether the camera was assumed, not measured."""
        return self.error is None

    @property
    def field_of_view(self) -> float:
        """Across the image's width, degrees."""
        return math.degrees(2 * math.atan(self.width / 2 / float(self.intrinsics[0, 0])))

    def resized(self, width: int, height: int) -> "CameraCalibration":
        """The same camera with its images scaled to another resolution of the same aspect.

        Raises:
            ValueRangeError: another aspect: part of the image was cropped, and which part is not known.
        """
        if (width, height) == (self.width, self.height):
            return self
        # The height is a whole number of pixels: it may be rounded.
        if width < 1 or height < 1 or abs(height - width * self.height / self.width) >= 1:
            raise ValueRangeError(
                f"calibration: made for {self.width} x {self.height} pixels, found images of {width} x {height}, "
                "expected the same aspect"
            )
        scale = torch.tensor([width / self.width, height / self.height, 1.0]).to(self.intrinsics)
        intrinsics = scale[:, None] * self.intrinsics
        # The image's corner, not the centre of its first pixel, stays where it is.
        intrinsics[:2, 2] += (scale[:2] - 1) / 2
        error = None if self.error is None else self.error * float(scale[0])
        return replace(self, intrinsics=intrinsics, width=width, height=height, error=error)


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera of several that are fixed to each other, such as a helmet's.

    Args:
        calibration: its own.
        rotation, translation: first camera to this one, (3,3) and (3,), millimetres.
        name: for people.
        offset: when its film began after the first one's, seconds; None where timecodes say so.

    Raises:
        ShapeError: rotation or translation of another shape.
        ValueRangeError: no rotation, or numbers that are not finite.

    Example:
        >>> one = assumed_calibration(640, 480)
        >>> PlacedCamera(one, torch.eye(3), torch.tensor([-60.0, 0, 0]), "right").translation.tolist()
        [-60.0, 0.0, 0.0]
    """

    calibration: CameraCalibration
    rotation: Tensor
    translation: Tensor
    name: str = ""
    offset: float | None = None

    def __post_init__(self) -> None:
        if self.rotation.shape != (3, 3) or self.translation.shape != (3,):
            raise ShapeError(
                f"camera {self.name}: found rotation {tuple(self.rotation.shape)} and translation "
                f"{tuple(self.translation.shape)}, expected (3,3) and (3,)"
            )
        R = self.rotation.double()
        turned = torch.isfinite(R).all() and (R @ R.T - torch.eye(3).to(R)).abs().max() < 1e-3 and torch.det(R) > 0
        if not (turned and torch.isfinite(self.translation).all()):
            raise ValueRangeError(
                f"camera {self.name}: found rotation {self.rotation.tolist()}, translation "
                f"{self.translation.tolist()}, expected a rotation matrix and finite millimetres"
            )


def assumed_calibration(width: int, height: int, field_of_view: float = ASSUMED_FIELD_OF_VIEW) -> CameraCalibration:
    """A camera without distortion whose principal point is the image's centre, where none was calibrated.

    Depths scale with the focal length: with a wrong one distances along the line of sight are wrong by as much, and
    rotations by a few degrees.

    Args:
        width, height: of the images, pixels.
        field_of_view: across the longer side, degrees.

    Returns:
        A calibration whose ``assumed`` is true.

    Raises:
        ValueRangeError: no pixels, or an angle outside 0 to 180.

    Example:
        >>> camera = assumed_calibration(640, 480)
        >>> round(float(camera.intrinsics[0, 0])), camera.assumed
        (554, True)
    """
    if width < 1 or height < 1 or not 0 < field_of_view < 180:
        raise ValueRangeError(
            f"assumed_calibration: found {width} x {height} pixels and {field_of_view} degrees, "
            "expected positive sizes and an angle between 0 and 180"
        )
    focal = max(width, height) / 2 / math.tan(math.radians(field_of_view) / 2)
    intrinsics = torch.tensor(
        [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]], dtype=torch.float64
    )
    return CameraCalibration(intrinsics, torch.zeros(5, dtype=torch.float64), width, height)
