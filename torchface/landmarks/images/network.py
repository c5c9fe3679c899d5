"""68 landmarks of a face in one pass of a small convolutional network: places, their uncertainty, what is hidden."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError, ValueRangeError
from torchface.files.documents import Value

COUNT = 68
_STRIDE = 4
_MOST_CHANNELS, _MOST_BLOCKS, _MOST_SIZE = 512, 16, 512
DEVIATION_RANGE = (0.05, 60.0)
"""Pixels of the crop; the network tells nothing beyond."""


class NetworkLandmarks(NamedTuple):
    """What the network finds in B crops.

    Args:
        landmarks: iBUG's 68, (B,68,2) pixels of the crop, whose centres are at integers.
        deviation: mean distance to be expected of each from the truth, (B,68) pixels of the crop.
        visibility: probability that nothing stands before it, (B,68).
        presence: probability that the crop shows a face in the place it expects, (B,).
    """

    landmarks: Tensor
    deviation: Tensor
    visibility: Tensor
    presence: Tensor


class LandmarkNetwork(nn.Module):
    r"""Landmarks by a convolutional encoder and decoder whose heat maps are read by their means.

    .. math:: x_l = \sum_p \mathrm{softmax}(h_l)_p \, p

    with :math:`h_l` the heat map of landmark l at a quarter of the crop's resolution. Features under the heat map tell
    how far off the landmark may be, and whether something hides it.

    Args:
        size: of a crop, pixels a side; a multiple of 16.
        margin: a crop's side, of the side of the face's box as ``box_around`` draws it.
        channels: at a half, a quarter, an eighth and a sixteenth of the resolution.
        blocks: residual blocks at a quarter, an eighth and a sixteenth.
        decoder: channels of the decoder at a quarter.

    Source: Newell, Yang, Deng 2016 (encoder and decoder); Sun et al. 2018 (means of heat maps); Kumar et al. 2020
    (uncertainty and visibility beside places).

    Example:
        >>> from torchface import zoo
        >>> network = zoo.get_model("landmark_network")
        >>> with torch.no_grad():
        ...     found = network(torch.full((1, 3, network.size, network.size), 0.5))
        >>> bool((found.landmarks >= 0).all() and (found.landmarks < network.size).all())  # pixels of the crop
        True
    """

    fit: ClassVar[Callable[..., LandmarkNetwork]]
    """:func:`torchface.landmarks.images.network_training.fit_network`, bound where this package begins."""

    def __init__(
        self,
        size: int = 112,
        margin: float = 1.25,
        channels: tuple[int, ...] = (16, 24, 48, 96),
        blocks: tuple[int, ...] = (1, 2, 2),
        decoder: int = 32,
    ) -> None:
        super().__init__()
        if not (32 <= size <= _MOST_SIZE and size % 16 == 0 and 0.5 <= margin <= 4):
            raise ValueRangeError(
                f"landmark network: found size {size}, margin {margin}; expected a multiple of 16 from 32 to "
                f"{_MOST_SIZE}, and 0.5 to 4"
            )
        if len(channels) != 4 or not all(1 <= count <= _MOST_CHANNELS for count in (*channels, decoder)):
            raise ValueRangeError(f"channels: found {channels} and {decoder}, expected four and one, 1 to 512 each")
        if len(blocks) != 3 or not all(0 <= count <= _MOST_BLOCKS for count in blocks):
            raise ValueRangeError(f"blocks: found {blocks}, expected three numbers, 0 to {_MOST_BLOCKS} each")
        self.size, self.margin = size, margin
        self.channels, self.blocks, self.decoder = tuple(channels), tuple(blocks), decoder
        half, quarter, eighth, sixteenth = channels
        self.stem = nn.Sequential(convolution(3, half, 2), convolution(half, quarter, 2))
        self.quarter = nn.Sequential(*[ResidualBlock(quarter) for _ in range(blocks[0])])
        self.eighth = nn.Sequential(convolution(quarter, eighth, 2), *[ResidualBlock(eighth) for _ in range(blocks[1])])
        self.sixteenth = nn.Sequential(
            convolution(eighth, sixteenth, 2), *[ResidualBlock(sixteenth) for _ in range(blocks[2])]
        )
        self.context = nn.Linear(sixteenth, sixteenth)
        self.up_eighth, self.mix_eighth = nn.Conv2d(sixteenth, eighth, 1), convolution(eighth, eighth)
        self.up_quarter, self.skip_quarter = nn.Conv2d(eighth, decoder, 1), nn.Conv2d(quarter, decoder, 1)
        self.mix_quarter = convolution(decoder, decoder)
        self.heat = nn.Conv2d(decoder, COUNT, 1)
        self.local = nn.Parameter(torch.zeros(COUNT, decoder, 2))
        self.local_bias = nn.Parameter(torch.zeros(COUNT, 2))
        self.presence = nn.Linear(sixteenth, 1)

    @property
    def config(self) -> dict[str, Any]:
        return {
            "size": self.size, "margin": self.margin, "channels": list(self.channels), "blocks": list(self.blocks),
            "decoder": self.decoder,
        }  # fmt: skip

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> Self:
        given = Value("config", "", config).table()
        return cls(
            given["size"].whole(), given["margin"].number(), tuple(one.whole() for one in given["channels"].rows()),
            tuple(one.whole() for one in given["blocks"].rows()), given["decoder"].whole(),
        )  # fmt: skip

    def forward(self, crops: Tensor) -> NetworkLandmarks:
        """Landmarks in crops, (B,3,S,S) in [0,1], red first.

        Raises:
            ShapeError: another shape.
        """
        if crops.ndim != 4 or crops.shape[1:] != (3, self.size, self.size):
            raise ShapeError(f"crops: found {tuple(crops.shape)}, expected (B,3,{self.size},{self.size})")
        return self.read(*self.maps(crops))

    def maps(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Heat maps (B,68,S/4,S/4), decoder features (B,C,S/4,S/4) and the logit of presence (B,)."""
        quarter = self.quarter(self.stem(2 * crops - 1))
        eighth = self.eighth(quarter)
        deep = self.sixteenth(eighth)
        pooled = deep.mean((2, 3))
        deep = deep + self.context(pooled)[:, :, None, None]
        eighth = self.mix_eighth(doubled(self.up_eighth(deep)) + eighth)
        features = self.mix_quarter(doubled(self.up_quarter(eighth)) + self.skip_quarter(quarter))
        return self.heat(features), features, self.presence(pooled)[:, 0]

    def read(self, heat: Tensor, features: Tensor, presence: Tensor) -> NetworkLandmarks:
        """Landmarks from what ``maps`` gives."""
        share = heat.flatten(2).softmax(-1)
        places = self.places(heat)
        landmarks = share @ places
        spread = (share @ places.square() - landmarks.square()).sum(-1).clamp(min=0)
        under = share @ features.flatten(2).transpose(1, 2)
        told = (under[..., None] * self.local).sum(2) + self.local_bias
        deviation = (told[..., 0] + 0.25 * (spread + 1).log()).exp()
        return NetworkLandmarks(
            landmarks, deviation.clamp(*DEVIATION_RANGE), told[..., 1].sigmoid(), presence.sigmoid()
        )

    def places(self, heat: Tensor) -> Tensor:
        """Where the cells of heat maps lie in the crop, (P,2) pixels."""
        line = (torch.arange(self.size // _STRIDE, device=heat.device, dtype=heat.dtype) + 0.5) * _STRIDE - 0.5
        return torch.stack(torch.meshgrid(line, line, indexing="xy"), dim=-1).reshape(-1, 2)


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
