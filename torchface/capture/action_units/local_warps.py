"""Augmentation: small smooth random warps of patterns, so that a classifier generalises to other faces."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

_CONTROL = 5  # control points a side


def local_warps(images: Tensor, amplitude: float, generator: torch.Generator, alike: int = 1) -> Tensor:
    """Regions (T,R,h,w), each frame and region warped by a smooth field of its own.

    Args:
        images: patterns.
        amplitude: standard deviation of the control points' displacement, pixels.
        generator: where the randomness comes from.
        alike: into how many parts the regions fall that get the same field, region by region.

    Source: thesis 4.1.14.
    """
    frames, regions, height, width = images.shape
    control = torch.randn(frames, regions // alike, 2, _CONTROL, _CONTROL, generator=generator)
    control = control.repeat(1, alike, 1, 1, 1).flatten(0, 1)
    field = interpolate(amplitude * control, (height, width), mode="bicubic", align_corners=True)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    places = torch.stack([x, y], dim=-1) + field.permute(0, 2, 3, 1)
    grid = 2 * places / torch.tensor([width, height]) - 1
    warped = grid_sample(
        images.reshape(frames * regions, 1, height, width), grid, padding_mode="border", align_corners=False
    )
    return warped.view_as(images)
