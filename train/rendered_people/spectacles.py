"""Spectacles drawn over a picture of someone."""

import math

import cv2
import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera

from .backdrops import uniform


def with_glasses(
    image: Tensor,
    camera: Camera,
    marks: Tensor,
    form: tuple[float, float, float, float, float],
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Spectacles of a form (``Looks.glasses``) drawn over an image (H,W,4), and which landmarks (68,3) dark lenses
    hide, (68,) bool."""
    half_width, half_height, grey, thickness, lens = form
    turn = torch.linspace(0, 2 * math.pi, 41).double()[:-1]
    square = uniform(0.35, 1.0, generator)  # the exponent of a superellipse: 1 is round
    drawn = image.numpy().copy()
    across, up = (way.sign() * way.abs() ** square for way in (turn.cos(), turn.sin()))
    ring = torch.stack([half_width * across, half_height * up, -2 * turn.cos() ** 2], -1)
    curves = [
        marks[eye].mean(0) + torch.tensor([0.0, -2.0, 13.0]).double() + ring for eye in (slice(36, 42), slice(42, 48))
    ]
    hidden = torch.zeros(68, dtype=torch.bool)
    tone = grey * torch.tensor([1.0, 0.9, 0.8]).numpy()
    for number, curve in enumerate(curves):
        line = (camera.project(curve).numpy() * 16).round().astype("int32")
        cover = drawn[..., 0] * 0
        cv2.fillPoly(cover, [line], 1.0, cv2.LINE_AA, 4)
        shade = uniform(0.0, 0.25, generator) if uniform(0, 1, generator) < 0.3 else 0.0  # a mirrored window
        inside = cover[..., None] * (drawn[..., 3:] > 0)
        drawn[..., :3] = drawn[..., :3] * (1 - lens * inside) + inside * (0.03 * lens + shade)
        hidden[36 + 6 * number : 42 + 6 * number] = lens > 0.8
    bridge = torch.stack([curves[0][0], curves[1][20]])
    arms = [torch.stack([curve[row], ear]) for curve, row, ear in zip(curves, (20, 0), marks[[0, 16]], strict=True)]
    width = max(1, round(thickness))
    for curve in (*curves, bridge, *arms):
        line = (camera.project(curve).numpy() * 16).round().astype("int32")
        cv2.polylines(drawn, [line], len(curve) > 2, (*map(float, tone), 1.0), width, cv2.LINE_AA, 4)
    return torch.from_numpy(drawn), hidden
