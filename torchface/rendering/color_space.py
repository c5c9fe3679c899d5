"""Colours as files hold them, and the light that they stand for."""

from __future__ import annotations

import torch
from torch import Tensor


def to_linear(colors: Tensor) -> Tensor:
    """sRGB in [0,1] to linear light. Source: IEC 61966-2-1."""
    return torch.where(colors <= 0.04045, colors / 12.92, ((colors.clamp(min=0) + 0.055) / 1.055).pow(2.4))


def to_srgb(light: Tensor) -> Tensor:
    """Linear light to sRGB. Source: IEC 61966-2-1."""
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp(min=0.0031308).pow(1 / 2.4) - 0.055)
