"""Colours as images hold them (sRGB), and the light that they stand for, for any layout of channels."""

import torch
from torch import Tensor

from torchface.errors import ShapeError


def to_linear(colors: Tensor) -> Tensor:
    """sRGB (...,3) in [0,1] to linear light. Source: IEC 61966-2-1."""
    return torch.where(colors <= 0.04045, colors / 12.92, ((colors.clamp(min=0) + 0.055) / 1.055).pow(2.4))


def to_srgb(light: Tensor) -> Tensor:
    """Linear light (...,3) to sRGB. Source: IEC 61966-2-1."""
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp(min=0.0031308).pow(1 / 2.4) - 0.055)


def grey_images(images: Tensor) -> Tensor:
    """Images (B,1,H,W) or (B,3,H,W) as grey ones (B,1,H,W), by the luma of BT.601."""
    if images.ndim != 4 or images.shape[1] not in (1, 3):
        raise ShapeError(f"images: found {tuple(images.shape)}, expected (B,1,H,W) or (B,3,H,W)")
    if images.shape[1] == 1:
        return images
    # Loaded here: kornia takes half a second, and most videos are grey already.
    from kornia.color import rgb_to_grayscale

    return rgb_to_grayscale(images)
