"""Building blocks of networks whose heat maps are read by their means: convolutions, and points from heat maps."""

from typing import NamedTuple

import torch
from torch import Tensor, nn


class ResidualBlock(nn.Module):
    """Two convolutions beside an identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = convolution(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.second(self.first(x)))


def convolution(before: int, after: int, stride: int = 1) -> nn.Sequential:
    """A convolution of 3 x 3, normalised and rectified."""
    return nn.Sequential(
        nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU(inplace=True)
    )


def doubled(x: Tensor) -> Tensor:
    """Maps (B,C,H,W) at twice the resolution."""
    return nn.functional.interpolate(x, scale_factor=2.0, mode="nearest")


def cell_places(heat: Tensor, stride: int) -> Tensor:
    """Where the cells of heat maps (B,L,h,w), ``stride`` pixels a side, lie in the crop, (h*w,2) pixels."""
    y, x = ((torch.arange(side).to(heat) + 0.5) * stride - 0.5 for side in heat.shape[2:])
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)


class HeatReading(NamedTuple):
    """What heat maps give."""

    points: Tensor  # their means, (B,L,2) pixels of the crop
    under: Tensor  # features under each, (B,L,C)
    widening: Tensor  # a quarter of the logarithm of the maps' variances and 1, (B,L): wide maps are uncertain ones


def read_heat(heat: Tensor, features: Tensor, stride: int) -> HeatReading:
    r"""Points as means of heat maps (B,L,h,w), :math:`x_l = \sum_p \mathrm{softmax}(h_l)_p \, p`.

    Features (B,C,h,w) are of the same cells.

    Source: Sun et al. 2018.
    """
    share = heat.flatten(2).softmax(-1)
    places = cell_places(heat, stride)
    points = share @ places
    variance = (share @ places.square() - points.square()).sum(-1).clamp(min=0)
    return HeatReading(points, share @ features.flatten(2).transpose(1, 2), 0.25 * (variance + 1).log())
