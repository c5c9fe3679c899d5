"""Gabor filters: where edges of which direction and width are."""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad

from torchface.errors import ShapeError

ORIENTATIONS = 4


class GaborBank(nn.Module):
    r"""The magnitudes of eight complex Gabor filters, two wavelengths at four orientations 45° apart.

    .. math:: g(x, y) = e^{-(x'^2 + y'^2) / 2\sigma^2} \left(e^{2\pi i x'/\lambda} - m\right),
        \quad x' = x \cos\theta + y \sin\theta

    with m such that even light gives no response. Magnitudes change little when a stroke moves by less than a
    wavelength, so they are kept at every ``stride``-th pixel only.

    Source: thesis 4.1.10.
    """

    even: Tensor
    odd: Tensor

    def __init__(self, wavelengths: tuple[float, float] = (6.0, 12.0), stride: int = 4) -> None:
        super().__init__()
        self.stride = stride
        reach = math.ceil(0.9 * max(wavelengths))
        kernels = torch.stack([
            _kernel(length, math.pi * k / ORIENTATIONS, reach) for length in wavelengths for k in range(ORIENTATIONS)
        ])  # fmt: skip
        self.register_buffer("even", kernels.real.float().contiguous()[:, None])
        self.register_buffer("odd", kernels.imag.float().contiguous()[:, None])

    def places(self, size: int) -> int:
        """Number of places along a side of ``size`` pixels are kept."""
        return (size - 1) // self.stride + 1

    def forward(self, images: Tensor) -> Tensor:
        """Responses (B,8,h',w') of images (B,h,w)."""
        if images.ndim != 3:
            raise ShapeError(f"images: found {tuple(images.shape)}, expected (B,h,w)")
        reach = self.even.shape[-1] // 2
        padded = pad(images[:, None], (reach,) * 4, mode="replicate")
        even, odd = conv2d(padded, torch.cat([self.even, self.odd]), stride=self.stride).chunk(2, dim=1)
        return (even.square() + odd.square() + 1e-8).sqrt()


def _kernel(wavelength: float, angle: float, reach: int) -> Tensor:
    """One filter (2*reach+1, 2*reach+1), complex128, of unit energy."""
    step = torch.arange(-reach, reach + 1, dtype=torch.float64, device="cpu")  # on "meta" it takes seconds to load
    y, x = torch.meshgrid(step, step, indexing="ij")
    along = x * math.cos(angle) + y * math.sin(angle)
    sigma = 0.42 * wavelength
    envelope = torch.exp(-(x**2 + y**2) / (2 * sigma**2))
    wave = torch.exp(2j * math.pi * along / wavelength)
    kernel = envelope * (wave - (envelope * wave).sum() / envelope.sum())
    return kernel / kernel.abs().square().sum().sqrt()
