"""Eyelashes drawn over a picture of someone: they follow the lids, and hang where the lids are closed."""

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera

from .backdrops import uniform

_FINE = 4  # parts of a pixel that lashes are drawn on
_RIMS = (((36, 37, 38, 39), 1.0), ((36, 41, 40, 39), -1.0), ((45, 44, 43, 42), 1.0), ((45, 46, 47, 42), -1.0))
_HIDDEN = 4.0  # millimetres that a root may lie behind what is seen


def with_lashes(
    image: Tensor,
    distance: Tensor,
    camera: Camera,
    marks: Tensor,
    tone: Tensor,
    dense: bool,
    generator: torch.Generator,
) -> Tensor:
    """Lashes of a tone, sRGB (3,), over an image (H,W,4) whose fourth channel is 1 on the person; ``dense`` ones show.

    ``distance`` is of what each pixel shows, (H,W), ``marks`` are iBUG's 68 on the head, (68,3), millimetres.
    """
    strength = uniform(0.35, 0.9, generator) if dense else uniform(0.05, 0.5, generator)
    length = uniform(6.0, 10.0, generator) if dense else uniform(4.0, 7.5, generator)
    cover = np.zeros((_FINE * camera.height, _FINE * camera.width), np.uint8)
    for rim, up in _RIMS:
        short, count = (1.0, 44) if up > 0 else (0.55, 26)
        curves = _curves(marks.double(), rim, up, short * length, count, generator)
        shown = _in_sight(curves[:, 0], camera, distance)
        pixels = (camera.project(curves) + 0.5) * _FINE - 0.5
        lines = [(8 * pixel).round().int().numpy() for pixel in pixels[shown]]
        cv2.polylines(cover, lines, False, 255 if up > 0 else 130, 1, cv2.LINE_AA, 3)
    size = (camera.width, camera.height)
    share = torch.from_numpy(cv2.resize(cover, size, interpolation=cv2.INTER_AREA)).float() / 255
    share = ((1.6 * strength * share).clamp(max=0.95) * image[..., 3])[..., None]
    colors = image[..., :3] * (1 - share) + tone * share
    return torch.cat([colors, image[..., 3:]], dim=-1)


def _curves(
    marks: Tensor, rim: tuple[int, ...], up: float, length: float, count: int, generator: torch.Generator
) -> Tensor:
    """Lashes along a lid's rim from its outer to its inner corner, (N,5,3) millimetres."""
    corner, first, second, inner = marks[list(rim)]
    along = torch.linspace(0.02, 0.86, count).double() + 0.012 * torch.randn(count, generator=generator).double()
    t = along.clamp(0, 0.95)[:, None]
    # Through four points of the rim at 0, 1/3, 2/3 and 1.
    basis = torch.cat([
        -4.5 * (t - 1 / 3) * (t - 2 / 3) * (t - 1), 13.5 * t * (t - 2 / 3) * (t - 1),
        -13.5 * t * (t - 1 / 3) * (t - 1), 4.5 * t * (t - 1 / 3) * (t - 2 / 3),
    ], dim=1)  # fmt: skip
    root = basis @ torch.stack([corner, first, second, inner])
    eyes = (marks[36:40].mean(0), marks[42:46].mean(0))
    middle = (eyes[0] if rim[0] == 36 else eyes[1]) - torch.tensor([0.0, 0.0, 11.0]).double()
    out = torch.nn.functional.normalize(root - middle, dim=1)
    side = torch.nn.functional.normalize(corner - inner, dim=0)
    out = torch.nn.functional.normalize(out + (0.9 * (0.55 - t)) * side, dim=1)
    bent = torch.tensor([0.0, 1.0, 0.0]).double() * up * uniform(0.2, 0.9, generator)
    own = length * (0.7 + 0.5 * torch.rand(count, 1, generator=generator).double()) * (1 - 0.55 * t)
    run = torch.linspace(0, 1, 5).double()[:, None]
    wild = 0.12 * torch.randn(count, 1, 3, generator=generator).double()
    return root[:, None] + own[:, None] * (run * (out[:, None] + wild) + run.square() * 0.6 * bent)


def _in_sight(points: Tensor, camera: Camera, distance: Tensor) -> Tensor:
    """Which points (N,3) nothing stands before, (N,) bool."""
    place = camera.project(points).round().long()
    inside = (place >= 0).all(1) & (place[:, 0] < camera.width) & (place[:, 1] < camera.height)
    x, y = place[:, 0].clamp(0, camera.width - 1), place[:, 1].clamp(0, camera.height - 1)
    return inside & (distance[y, x] > (points - camera.centre).norm(dim=1) - _HIDDEN)
