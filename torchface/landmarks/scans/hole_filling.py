"""Missing pixels filled smoothly from around them, so that a hole brings no edges."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad


def fill_holes(image: Tensor, mask: Tensor) -> Tensor:
    """Keeps an image where the mask is set and fills the rest from ever coarser means around (push and pull).

    Args:
        image: (C,H,W) float32.
        mask: where it is known, (H,W) bool, somewhere at least.

    Returns:
        (C,H,W); untouched where known.

    Source: Gortler et al. 1996, The Lumigraph, 3.4.
    """
    weight = mask[None, None].to(image)
    return _pull(image[None] * weight, weight)[0]


def _pull(weighted: Tensor, weight: Tensor) -> Tensor:
    known = weighted / weight.clamp(min=1e-9)
    height, width = weight.shape[-2:]
    if bool((weight > 0).all()) or max(height, width) == 1:
        return known
    odd = (0, width % 2, 0, height % 2)
    coarse = _pull(avg_pool2d(pad(weighted, odd), 2), avg_pool2d(pad(weight, odd), 2))
    around = interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)[..., :height, :width]
    return torch.where(weight > 0, known, around)
