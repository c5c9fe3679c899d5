"""Light from all around, as a panorama holds it, reflected as by chalk."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError

# Of the clamped cosine, over pi: what chalk keeps of the degrees 0, 1 and 2.
_KEPT = (1.0, *(2 / 3,) * 3, *(1 / 4,) * 5)


@dataclass(frozen=True, eq=False)
class EnvironmentLight:
    r"""Light from all around in nine spherical harmonics, which show chalk within 1 % on average; nothing shades.

    .. math:: I(N) = \sum_{lm} \frac{A_l}{\pi} L_{lm} Y_{lm}(N)

    Source: Ramamoorthi and Hanrahan 2001, An Efficient Representation for Irradiance Environment Maps.
    """

    # A_l L_{lm} / \pi of red, green, blue in the camera's frame (x right, y down, z forward), (9,3); light of 1 from
    # everywhere shows the albedo as it is
    coefficients: Tensor

    def __post_init__(self) -> None:
        if self.coefficients.shape != (9, 3):
            raise ShapeError(f"environment: found {tuple(self.coefficients.shape)}, expected (9,3)")
        if not bool(torch.isfinite(self.coefficients).all()):
            raise ValueRangeError("environment: found NaN or infinite coefficients, expected none")

    @staticmethod
    def of(panorama: Tensor, turn: float = 0.0) -> "EnvironmentLight":
        """The light of a panorama around the face.

        Args:
            panorama: equirectangular, linear, (3,H,W), first row straight up; its middle is where the camera stands,
                its right half lies at the viewer's left.
            turn: of the panorama about the vertical, degrees; positive moves its middle to the viewer's right.
        """
        if panorama.ndim != 3 or panorama.shape[0] != 3 or 0 in panorama.shape:
            raise ShapeError(f"panorama: found {tuple(panorama.shape)}, expected (3,H,W)")
        if not bool(torch.isfinite(panorama).all()) or bool((panorama < 0).any()):
            raise ValueRangeError("panorama: found negative or not finite light, expected none")
        height, width = panorama.shape[1:]
        around = ((torch.arange(width) + 0.5) / width - 0.5).double() * 2 * math.pi - math.radians(turn)
        up = (0.5 - (torch.arange(height) + 0.5) / height).double() * math.pi
        up, around = torch.meshgrid(up, around, indexing="ij")
        toward = torch.stack([-up.cos() * around.sin(), -up.sin(), -up.cos() * around.cos()], -1)
        solid = up.cos() * (math.pi / height) * (2 * math.pi / width)
        light = torch.einsum("hwk,hw,chw->kc", harmonics(toward), solid, panorama.double())
        return EnvironmentLight(light * torch.tensor(_KEPT, dtype=torch.float64)[:, None])

    @property
    def mean(self) -> Tensor:
        """Light in the mean of all directions, (3,)."""
        return self.coefficients[0] * harmonics(torch.eye(3, dtype=torch.float64))[0, 0]

    @property
    def on_front(self) -> Tensor:
        """Light on a ball that the camera sees, in the mean over its disc in the picture, (3,)."""
        toward_camera = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
        kept = harmonics(toward_camera)[0] * torch.tensor(_KEPT, dtype=torch.float64)
        return kept @ self.coefficients.double()

    def scaled(self, factor: float) -> "EnvironmentLight":
        """The same, so many times as bright."""
        return EnvironmentLight(self.coefficients * factor)

    def irradiance(self, normals: Tensor) -> Tensor:
        """What it brings to surfaces with unit normals (...,3) in the camera's frame, (...,3), linear."""
        return (harmonics(normals) @ self.coefficients.to(normals)).clamp(min=0)


def harmonics(directions: Tensor) -> Tensor:
    """The nine real spherical harmonics of degree 2 at most, (...,9)."""
    x, y, z = directions.unbind(-1)
    return torch.stack(
        [
            torch.full_like(x, 0.28209479),
            *(0.48860251 * axis for axis in (y, z, x)),
            *(1.09254843 * product for product in (x * y, y * z, x * z)),
            0.31539157 * (3 * z * z - 1),
            0.54627422 * (x * x - y * y),
        ],
        -1,
    )
