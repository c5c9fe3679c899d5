"""Parts of a face in a picture by a small convolutional network: skin, hair, brows, eyes, glasses, hands, cloth."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pixel_shuffle
from torch.utils.data import Dataset

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.networks.eye_network import evened
from torchface.landmarks.images.networks.heat_maps import convolution
from torchface.landmarks.images.networks.picture_network import PictureNetwork
from torchface.optim import DescentSettings, DescentTask

PARTS = ("background", "skin", "hair", "brows", "eyes", "lips", "teeth", "glasses", "hand", "cloth")
"""In the order of the network's channels. Beards are hair, hats are cloth, all that is between the lips is teeth, and
what a clear lens shows is what lies behind it."""
PART_SIZE = 128  # pixels a side of a crop
PART_MARGIN = 1.7  # a crop's side in sides of the face's box
_MOST_CHANNELS, _MOST_BLOCKS = 256, 8


class PartNetwork(PictureNetwork):
    r"""The share of each of :data:`PARTS` in each pixel by an encoder and decoder of separable convolutions.

    .. math:: p_{c} = \mathrm{softmax}_c \, f(x)

    with f at half of the crop's resolution; four scores a channel and cell, rearranged, give each pixel its own.

    Args:
        channels: at a half, a quarter, an eighth and a sixteenth of the resolution.

    :meth:`fit` takes pictures uint8 (B,3,H,W), the number of the part in :data:`PARTS` of each pixel uint8 (B,H,W), and
    the faces' boxes (B,4) pixels. It minimises cross entropy and lack of overlap (Milletari et al. 2016).

    Source: Ronneberger, Fischer, Brox 2015 (encoder and decoder); Howard et al. 2017 (separable convolutions); Shi et
    al. 2016 (pixels from channels).

    Example:
        >>> network = PartNetwork().eval()
        >>> with torch.no_grad():
        ...     shares = network(torch.full((1, 3, 128, 128), 0.5))
        >>> shares.shape == (1, 10, 128, 128), bool((shares.sum(1) - 1).abs().max() < 1e-5)
        (True, True)
    """

    def __init__(self, channels: tuple[int, ...] = (16, 40, 80, 128), blocks: tuple[int, ...] = (1, 2, 3, 3)) -> None:
        super().__init__()
        if len(channels) != 4 or not all(1 <= count <= _MOST_CHANNELS for count in channels):
            raise ValueRangeError(f"channels: found {channels}, expected four numbers, 1 to {_MOST_CHANNELS} each")
        if len(blocks) != 4 or not all(0 <= count <= _MOST_BLOCKS for count in blocks):
            raise ValueRangeError(f"blocks: found {blocks}, expected four numbers, 0 to {_MOST_BLOCKS} each")
        self.channels, self.blocks = tuple(channels), tuple(blocks)
        down, before = [], 3
        for number, (count, depth) in enumerate(zip(channels, blocks, strict=True)):
            first = convolution(before, count, 2) if number == 0 else _separable(before, count, 2)
            down.append(nn.Sequential(first, *[_Block(count) for _ in range(depth)]))
            before = count
        self.down = nn.ModuleList(down)
        self.context = nn.Linear(channels[-1], channels[-1])
        steps = list(zip(channels[:0:-1], channels[-2::-1], strict=True))
        self.lift = nn.ModuleList(nn.Conv2d(deep, shallow, 1) for deep, shallow in steps)
        self.mix = nn.ModuleList(_Block(shallow) for _, shallow in steps)
        self.scores = nn.Conv2d(channels[0], 4 * len(PARTS), 1)

    @classmethod
    def _usual_settings(cls) -> DescentSettings:
        from torchface.landmarks.images.networks.part_training import PartSettings

        return PartSettings()

    def _task(self, pictures: Dataset[Any], settings: Any, device: str | torch.device) -> DescentTask[Any]:
        from torchface.landmarks.images.networks.part_training import part_task

        return part_task(self, pictures, settings, device)

    def forward(self, crops: Tensor) -> Tensor:
        """Shares (B,10,H,W) of the parts in crops (B,3,H,W) in [0,1], red first; it has learned from 128 x 128."""
        if crops.ndim != 4 or crops.shape[1] != 3 or any(side % 16 or side < 16 for side in crops.shape[2:]):
            raise ShapeError(f"crops: found {tuple(crops.shape)}, expected (B,3,H,W), sides multiples of 16")
        return self.logits(crops).softmax(1)

    def logits(self, crops: Tensor) -> Tensor:
        """Scores (B,10,S,S)."""
        x, kept = evened(crops.to(self.scores.weight)), []
        for stage in self.down:
            x = stage(x)
            kept.append(x)
        x = x + self.context(x.mean((2, 3)))[:, :, None, None]
        for lift, mix, beside in zip(self.lift, self.mix, kept[-2::-1], strict=True):
            x = mix(interpolate(lift(x), scale_factor=2.0, mode="bilinear", align_corners=False) + beside)
        return pixel_shuffle(self.scores(x), 2)


def _separable(before: int, after: int, stride: int = 1) -> nn.Sequential:
    """A convolution of 3 x 3 in each channel, then one over the channels, normalised and rectified."""
    return nn.Sequential(
        nn.Conv2d(before, before, 3, stride, 1, groups=before, bias=False), nn.BatchNorm2d(before),
        nn.Conv2d(before, after, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU(inplace=True),
    )  # fmt: skip


class _Block(nn.Module):
    """Two separable convolutions beside an identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first, self.second = _separable(channels, channels), _separable(channels, channels)[:-1]

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.second(self.first(x)))
