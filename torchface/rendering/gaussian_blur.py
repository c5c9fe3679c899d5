"""Gaussian blur of images, and the unsharp mask made of it."""

import math

from torch import Tensor


def gaussian_blur(images: Tensor, sigma: float, truncate: float = 3.0) -> Tensor:
    """Images (B,C,H,W) blurred with a standard deviation in pixels; the border is repeated outward."""
    # Loaded here: kornia takes half a second, and most of what imports this module never blurs.
    from kornia.filters import gaussian_blur2d

    if sigma == 0:
        return images
    size = 2 * max(1, math.ceil(truncate * sigma)) + 1
    return gaussian_blur2d(images, (size, size), (sigma, sigma), border_type="replicate")


def unsharp(images: Tensor, sigma: float, amount: float) -> Tensor:
    r"""Images (B,C,H,W) with their detail raised: :math:`I + a\,(I - G_\sigma * I)`.

    Source: thesis 3.2.2 (the pre-filter).
    """
    return images + amount * (images - gaussian_blur(images, sigma))
