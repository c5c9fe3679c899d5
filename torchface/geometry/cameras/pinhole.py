"""Pinhole cameras in OpenCV's convention: K, [R|t], x right, y down, pixel centres at integers."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.number_checks import checked_count, checked_number

__all__ = ["Camera", "look_at"]

MAX_SIDE = 16384  # pixels that an image may have a side
MAX_ANGLE = 36000.0  # degrees; beyond a hundred turns rounding errors show


@dataclass(frozen=True, eq=False)
class Camera:
    """One pinhole camera.

    Args:
        intrinsics: K, (3,3), pixels.
        rotation: world to camera, (3,3).
        translation: world to camera, (3,), millimetres.
        width, height: of the image, pixels.

    Raises:
        ValueRangeError: a side is not 1 to 16384 pixels.

    Example:
        >>> K = torch.tensor([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]], dtype=torch.float64)
        >>> camera = Camera(K, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), 640, 480)
        >>> camera.project(torch.tensor([[10.0, 0.0, 900.0]], dtype=torch.float64)).tolist()
        [[330.0, 240.0]]
    """

    intrinsics: Tensor
    rotation: Tensor
    translation: Tensor
    width: int
    height: int

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            checked_count(f"camera: {name}", getattr(self, name), 1, MAX_SIDE)

    @property
    def centre(self) -> Tensor:
        """Where the camera stands in the world, (3,)."""
        return -self.rotation.T @ self.translation

    def project(self, points: Tensor) -> Tensor:
        """Pixels (...,2) of world points (...,3)."""
        seen = points @ self.rotation.T.to(points) + self.translation.to(points)
        image = seen @ self.intrinsics.T.to(points)
        return image[..., :2] / image[..., 2:]

    def rays(self, samples: int = 1) -> tuple[Tensor, Tensor]:
        """Origins and unit directions of the viewing rays, each (H*s, W*s, 3), ``samples`` s a pixel side."""
        step = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
        x = (torch.arange(self.width)[:, None] + step).flatten()
        y = (torch.arange(self.height)[:, None] + step).flatten()
        grid = torch.stack([*torch.meshgrid(x, y, indexing="xy"), torch.ones(len(y), len(x), dtype=x.dtype)], dim=-1)
        back = torch.linalg.inv(self.intrinsics.double()).T @ self.rotation.double()
        directions = torch.nn.functional.normalize(grid @ back, dim=-1)
        return self.centre.double().expand_as(directions), directions


def look_at(
    target: Tensor,
    yaw: float,
    pitch: float = 0.0,
    span: float = 300.0,
    width: int = 512,
    height: int = 640,
    field_of_view: float = 18.0,
) -> Camera:
    """A camera that looks at a point from an angle, like a portrait photographer's.

    Args:
        target: what is looked at, (3,), millimetres.
        yaw: degrees; 0 sees the face from the front, 90 from the viewer's right.
        pitch: degrees; positive looks down from above.
        span: how many millimetres the image's height covers at the target.
        width, height: pixels.
        field_of_view: vertical, degrees; small is a long lens from far away.

    Raises:
        ValueRangeError: an angle, ``span`` or a size is NaN or out of range.

    Example:
        >>> camera = look_at(torch.zeros(3), yaw=30.0, span=300.0, width=512, height=640)
        >>> camera.project(torch.zeros(1, 3, dtype=torch.float64)).round().tolist()  # in the middle
        [[255.0, 320.0]]
    """
    for name, angle in (("yaw", yaw), ("pitch", pitch)):
        checked_number(name, angle, -MAX_ANGLE, MAX_ANGLE)
    checked_number("span", span, above=True)
    distance = span / 2 / math.tan(math.radians(field_of_view) / 2)
    a, b = math.radians(yaw), math.radians(pitch)
    viewing_direction = torch.tensor(
        [math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)], dtype=torch.float64
    )
    forward = -viewing_direction
    right = torch.tensor([math.cos(a), 0.0, -math.sin(a)], dtype=torch.float64)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward])
    centre = target.double() + distance * viewing_direction
    focal = height / 2 / math.tan(math.radians(field_of_view) / 2)
    intrinsics = torch.tensor(
        [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]], dtype=torch.float64
    )
    return Camera(intrinsics, rotation, -rotation @ centre, width, height)
