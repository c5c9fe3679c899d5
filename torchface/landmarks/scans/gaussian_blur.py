"""Gaussian blur of images, and the unsharp mask made of it."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad


def gaussian_kernel(sigma: float) -> Tensor:
    """Weights (2R+1,) float64 that sum to 1, out to three standard deviations."""
    reach = max(1, math.ceil(3 * sigma))
    # Numbers, not tensors: an exported graph holds the kernel and not how it came about.
    kernel = [math.exp(-0.5 * (i / sigma) ** 2) for i in range(-reach, reach + 1)]
    return torch.tensor([weight / sum(kernel) for weight in kernel], dtype=torch.float64)


def gaussian_blur(image: Tensor, sigma: float) -> Tensor:
    """Images (B,C,H,W) blurred with standard deviation ``sigma`` pixels; the border is repeated outward."""
    kernel = gaussian_kernel(sigma).to(image)
    reach = len(kernel) // 2
    batch, channels, height, width = image.shape
    flat = pad(image.reshape(batch * channels, 1, height, width), (reach,) * 4, mode="replicate")
    blurred = conv2d(conv2d(flat, kernel.view(1, 1, 1, -1)), kernel.view(1, 1, -1, 1))
    return blurred.view(batch, channels, height, width)


def unsharp(image: Tensor, sigma: float, amount: float) -> Tensor:
    r"""Images (B,C,H,W) with their detail raised: :math:`I + a\,(I - G_\sigma * I)`.

    Source: thesis 3.2.2 (the pre-filter).
    """
    return image + amount * (image - gaussian_blur(image, sigma))
