"""Hole filling, blur and unsharp mask."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from torchface.landmarks.scans.hole_filling import fill_holes
from torchface.rendering.gaussian_blur import gaussian_blur, unsharp


def test_known_pixels_stay_and_holes_follow_what_is_around() -> None:
    x, y = torch.meshgrid(torch.arange(65.0), torch.arange(48.0), indexing="xy")
    image = torch.stack([0.01 * x, 0.5 + 0.002 * y])
    mask = torch.ones(48, 65, dtype=torch.bool)
    mask[10:22, 30:41] = False
    mask[:, 60:] = False
    filled = fill_holes(image * mask, mask)
    assert torch.equal(filled[:, mask], (image * mask)[:, mask])
    hole = torch.zeros_like(mask)
    hole[10:22, 30:41] = True
    assert (filled[:, hole] - image[:, hole]).abs().max() < 0.06
    low, high = image[0][mask].aminmax()
    assert filled[0].min() >= low - 1e-6
    assert filled[0].max() <= high + 1e-6


def test_one_known_pixel_fills_everything() -> None:
    mask = torch.zeros(17, 9, dtype=torch.bool)
    mask[3, 4] = True
    assert torch.allclose(fill_holes(mask.float()[None] * 0.7, mask), torch.full((1, 17, 9), 0.7))


def test_blur_agrees_with_scipy() -> None:
    image = torch.rand(2, 3, 40, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = gaussian_filter(image.numpy(), (0, 0, 2.0, 2.0), mode="nearest", truncate=3.0)
    assert np.abs(gaussian_blur(image, 2.0).numpy() - expected).max() < 1e-9


def test_unsharp_raises_an_edge_and_leaves_flat_parts() -> None:
    image = torch.zeros(1, 1, 20, 60)
    image[..., 30:] = 1.0
    sharp = unsharp(image, 2.0, 1.0)
    assert sharp.max() > 1.3
    assert torch.allclose(sharp[..., :15], image[..., :15], atol=1e-5)
