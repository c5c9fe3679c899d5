"""Features of every pixel that do not depend on brightness and gain."""

import math
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from torchface.errors import NameMismatchError

Features = Literal["grey", "gradient_direction", "oriented_gradients"]
CHANNELS: dict[str, int] = {"grey": 1, "gradient_direction": 2, "oriented_gradients": 8}
"""The kinds of features, and how many channels each has."""

_FAINT = 0.01  # grey values a pixel: gradients below count as flat
_WINDOW = 17  # pixels of the neighbourhood that grey values are measured against
_CELL = 1.5  # pixels: deviation of the window that gradients are gathered in
_BELL = [math.exp(-(step**2) / (2 * _CELL**2)) for step in range(-4, 5)]


def dense_features(images: Tensor, kind: Features) -> Tensor:
    r"""Features of every pixel, (B,C,H,W), C as in ``CHANNELS``.

    ``grey``
        grey values less the mean of their neighbourhood, in units of its deviation.
    ``gradient_direction``
        the gradient's direction, :math:`g / \sqrt{|g|^2 + \epsilon^2}`: a unit vector but where the image is flat.
    ``oriented_gradients``
        how much gradient there is in each of eight directions round a pixel, divided by how much there is in all.

    Args:
        images: grey, (B,1,H,W) in [0,1].

    Source: Tzimiropoulos, Zafeiriou, Pantic 2012 (directions); Lowe 2004, Antonakos et al. 2015 (histograms).
    """
    if kind == "grey":
        mean = _window_mean(images)
        return (images - mean) / (_window_mean(images.square()) - mean.square() + _FAINT**2).clamp(min=1e-8).sqrt()
    padded = pad(images, (1, 1, 1, 1), mode="replicate")
    along_x = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2
    along_y = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2
    if kind == "gradient_direction":
        strength = (along_x.square() + along_y.square() + _FAINT**2).sqrt()
        return torch.cat([along_x, along_y], dim=1) / strength
    if kind == "oriented_gradients":
        angle = torch.arange(4, dtype=images.dtype, device=images.device)[:, None, None] * (math.pi / 4)
        directed = angle.cos() * along_x + angle.sin() * along_y
        # The other four directions are these four's opposites.
        directed = torch.cat([directed, -directed], dim=1).clamp(min=0)
        gathered = _filtered(directed, images.new_tensor(_BELL) / sum(_BELL))
        around = _filtered(gathered.square().sum(1, keepdim=True), images.new_full((7,), 1 / 7))
        return gathered * (around + _FAINT**2).rsqrt()
    raise NameMismatchError(f"features: found {kind!r}, expected one of {', '.join(get_args(Features))}")


def _filtered(images: Tensor, kernel: Tensor) -> Tensor:
    """Every channel convolved with a kernel (S,) of odd size across and down, the border continued."""
    reach, channels = len(kernel) // 2, images.shape[1]
    padded = pad(images, (reach,) * 4, mode="replicate")
    down = conv2d(padded, kernel.view(1, 1, -1, 1).expand(channels, -1, -1, -1), groups=channels)
    return conv2d(down, kernel.view(1, 1, 1, -1).expand(channels, -1, -1, -1), groups=channels)


def _window_mean(images: Tensor) -> Tensor:
    return avg_pool2d(images, _WINDOW, 1, _WINDOW // 2, count_include_pad=False)
