"""Features of a face on a grid in the face's own frame, and convolutions that read them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchface.landmarks.images.networks.heat_maps import ResidualBlock, convolution

_SIDE, _EXTENT = 20, 1.8  # cells a side, and half the side, of a face's size
_CHANNELS = (48, 96, 128)  # on the grid, on a half and on a quarter of it
_NUMBERS = 16  # that are read off each cell of the last
_LAST = _SIDE // 4


class FaceGrid(nn.Module):
    """What a face's features say where they lie on the face, however it is turned, moved or scaled in the crop.

    Args:
        channels: of each map of features that is sampled.

    Source: Jaderberg et al. 2015 (features sampled in the frame of what they show).
    """

    cells: Tensor

    def __init__(self, channels: Sequence[int]) -> None:
        super().__init__()
        side = _EXTENT * torch.linspace(-1, 1, _SIDE, device="cpu")
        self.register_buffer("cells", torch.cartesian_prod(side, side).flip(1))
        fine, middle, coarse = _CHANNELS
        self.narrow = nn.Sequential(
            nn.Conv2d(sum(channels), fine, 1, bias=False), nn.BatchNorm2d(fine), nn.ReLU(inplace=True)
        )
        self.read = nn.Sequential(
            ResidualBlock(fine),
            convolution(fine, middle, 2),
            ResidualBlock(middle),
            convolution(middle, coarse, 2),
        )
        self.each = normal(0.1, _LAST**2, coarse, _NUMBERS)

    @property
    def numbers(self) -> int:
        """How many it reads of a face."""
        return self.each.shape[0] * self.each.shape[2]

    def forward(self, maps: Sequence[Tensor], middle: Tensor, axes: Tensor, size: int) -> Tensor:
        """Numbers (B,N) of faces.

        Args:
            maps: of features, (B,C,h,w) each, of the whole crop.
            middle, axes: the faces' frames, (B,1,2) and (B,2,2) pixels; see ``face_frame``.
            size: pixels a side of the crop.
        """
        places = self.cells @ axes + middle
        sampled = torch.cat([sampled_at(one, places, size) for one in maps], 2).transpose(1, 2)
        read = self.read(self.narrow(sampled.unflatten(2, (_SIDE, _SIDE)))).flatten(2).transpose(1, 2)
        return each_row(read, self.each).flatten(1)


def normal(deviation: float, *shape: int) -> nn.Parameter:
    """Normally distributed numbers; on "meta" none: what computes there loads torch's compiler, two seconds."""
    empty = torch.empty(shape)
    return nn.Parameter(empty if empty.is_meta else empty.normal_(std=deviation))


def sampled_at(features: Tensor, pixels: Tensor, size: int) -> Tensor:
    """Features (B,C,h,w) of crops of ``size`` pixels a side at places (B,L,2), (B,L,C); at the edge beyond it.

    The same as ``grid_sample``, of which ONNX Runtime's takes three times as long as four rows that are taken whole.
    """
    batch, channels, high, wide = features.shape
    x, y = ((pixels + 0.5) * (wide / size) - 0.5).unbind(-1)
    x, y = x.clamp(0, wide - 1), y.clamp(0, high - 1)
    left, top = x.floor().clamp(max=wide - 2), y.floor().clamp(max=high - 2)
    across, down = (x - left)[..., None], (y - top)[..., None]
    rows = features.flatten(2).transpose(1, 2).reshape(-1, channels)
    first = (top * wide + left).long() + high * wide * torch.arange(batch, device=features.device)[:, None]
    above = torch.lerp(rows[first], rows[first + 1], across)
    return torch.lerp(above, torch.lerp(rows[first + wide], rows[first + wide + 1], across), down)


def each_row(features: Tensor, rows: Tensor) -> Tensor:
    """Products (B,L,K) of features (B,L,C) with rows (L,C,K) of their own."""
    return torch.bmm(features.transpose(0, 1), rows).transpose(0, 1)
