"""Hole filling: known pixels stay, holes follow what is around them."""

from __future__ import annotations

import torch

from torchface.landmarks.scans.hole_filling import fill_holes


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
