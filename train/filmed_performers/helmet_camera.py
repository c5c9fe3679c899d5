"""A camera on a helmet: where it hangs before the face, how it shakes, what it shows of the helmet."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera, look_at

HELMET_POINT = (0.0, 70.0, 99.0)
"""A bolt of the helmet's rim over the forehead, which the camera sees."""

# Plates of the rim: centre, width and height in millimetres, depth, grey.
_PLATES = (
    ((0.0, 71.0, 98.0), (120.0, 15.0), 0.10),
    ((0.0, 70.0, 98.5), (9.0, 9.0), 0.75),
    ((0.0, 70.0, 98.8), (4.0, 4.0), 0.03),
    ((-34.0, 72.0, 98.5), (14.0, 3.0), 0.30),
    ((34.0, 72.0, 98.5), (14.0, 3.0), 0.30),
)


@dataclass(frozen=True)
class CameraFlaws:
    """What is wrong with the images."""

    noise: float = 0.02  # standard deviation of a grey value at full brightness, of 1; read noise is a third of it
    exposure: float = 1.0  # brightness against a well exposed image
    blur: float = 0.5  # of the lens, standard deviation in pixels
    vignette: float = 0.25  # how much darker the corners are
    shake_rotation: float = 0.35  # amplitude of the camera's shake about each axis, degrees
    shake_translation: float = 0.7  # along each axis, millimetres


def helmet_camera(width: int = 192, height: int = 256) -> Camera:
    """The camera at rest: on a boom before the mouth, tilted up, upright images from the helmet's rim to the chin."""
    return look_at(torch.tensor([0.0, -19.0, 84.0]), 0.0, -9.0, 196.0, width, height, 46.0)


def helmet_plates() -> tuple[Tensor, Tensor, Tensor]:
    """What the camera sees of the helmet: vertices (V,3), faces (F,3), grey values of the faces (F,)."""
    vertices, faces, greys = [], [], []
    for i, ((x, y, z), (width, height), grey) in enumerate(_PLATES):
        a, b = width / 2, height / 2
        vertices += [(x - a, y - b, z), (x + a, y - b, z), (x + a, y + b, z), (x - a, y + b, z)]
        faces += [(4 * i, 4 * i + 1, 4 * i + 2), (4 * i, 4 * i + 2, 4 * i + 3)]
        greys += [grey, grey]
    return torch.tensor(vertices, dtype=torch.float64), torch.tensor(faces), torch.tensor(greys)


def shaken_cameras(
    camera: Camera, frames: int, fps: float, flaws: CameraFlaws, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """The camera's rotation (T,3,3) and translation (T,3), world to camera, as it sways and shakes.

    Half of the amplitude is a sway of some seconds, half a shake of up to 6 Hz; the camera turns about itself.
    """
    seconds = torch.arange(frames, dtype=torch.float64) / fps

    def curves(slow: float, fast: float) -> Tensor:
        rate = slow + (fast - slow) * torch.rand(6, 5, generator=generator, dtype=torch.float64)
        phase = 2 * math.pi * torch.rand(6, 5, generator=generator, dtype=torch.float64)
        curve = torch.sin(2 * math.pi * rate * seconds[:, None, None] + phase).sum(-1)
        return curve / curve.abs().amax(0).clamp(min=1e-9)

    motion = 0.5 * curves(0.05, 0.4) + 0.5 * curves(1.0, 6.0)
    angle = math.radians(flaws.shake_rotation) * motion[:, :3]
    skew = torch.zeros(frames, 3, 3, dtype=torch.float64)
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -angle[:, 2], angle[:, 1], -angle[:, 0]
    rotation_step = torch.linalg.matrix_exp(skew - skew.transpose(1, 2))
    rotation = rotation_step @ camera.rotation.double()
    translation = rotation_step @ camera.translation.double() + flaws.shake_translation * motion[:, 3:]
    return rotation, translation
