"""An eye in one pass of a small convolutional network: lids, iris, how sure each is, and how far it is open."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.networks.eye_crop import CROP_HEIGHT, CROP_WIDTH
from torchface.landmarks.images.networks.heat_maps import ResidualBlock, convolution, doubled, read_heat
from torchface.landmarks.images.networks.picture_network import PictureNetwork
from torchface.optim import DescentSettings, DescentTask

POINTS = 7  # six landmarks of the lids, then the iris's centre
STRIDE = 2  # pixels of the crop a side of a heat map's cell
DEVIATION_RANGE = (0.05, 40.0)  # pixels of the crop, of the deviations that the network states
LEAST_SPREAD = 0.03  # of a crop's brightness, so that what shows nothing is not made to show something
_MOST_CHANNELS, _MOST_BLOCKS, _MOST_SIDE = 256, 8, 256


class EyeFindings(NamedTuple):
    """What the network finds in B crops of right eyes, or of left ones in a mirror.

    Args:
        landmarks: of the lids, (B,6,2) pixels of the crop, in the order of ``EYE_LANDMARKS``.
        iris: its centre, (B,2) pixels of the crop.
        deviation: mean distance to be expected of the six and of the iris from the truth, (B,7) pixels of the crop.
        openness: the lids' distance over that of the corners, on the head, (B,); not less as heads nod.
        closed: probability that the eye is shut, (B,).
        visibility: probability that nothing hides the eye, (B,).
    """

    landmarks: Tensor
    iris: Tensor
    deviation: Tensor
    openness: Tensor
    closed: Tensor
    visibility: Tensor


class EyeNetwork(PictureNetwork):
    r"""Lids and iris by a convolutional encoder and decoder whose heat maps are read by their means.

    .. math:: x_l = \sum_p \mathrm{softmax}(h_l)_p \, p

    with :math:`h_l` the heat map of point l at half of the crop's resolution. Features under the heat maps give the
    deviation of each point; with those of the whole crop, how far the eye is open, and whether it is shut or hidden.

    Args:
        width, height: of a crop, pixels; multiples of 8.
        channels: at a half, a quarter and an eighth of the resolution.
        blocks: residual blocks there.
        hidden: units between features and what is read of the whole eye.

    :meth:`fit` takes cut-out pictures of both eyes, uint8 (B,4,H,W), see ``train/rendered_people/eye_picture.py``; then
    what is known of them, in the order of ``EyeLabels``. It minimises what a ``LandmarkNetwork`` does of places, gaps
    of the lids, the form of heat maps, errors of openness and cross entropies.

    Source: Newell, Yang, Deng 2016 (encoder and decoder); Sun et al. 2018 (means of heat maps).

    Example:
        >>> from torchface import zoo
        >>> network = zoo.get_model("eye_network")
        >>> with torch.no_grad():
        ...     found = network(torch.full((2, 3, 32, 48), 0.5))
        >>> found.landmarks.shape == (2, 6, 2)
        True
    """

    def __init__(
        self,
        width: int = CROP_WIDTH,
        height: int = CROP_HEIGHT,
        channels: tuple[int, ...] = (16, 32, 32),
        blocks: tuple[int, ...] = (1, 1, 1),
        hidden: int = 24,
    ) -> None:
        super().__init__()
        if not all(16 <= side <= _MOST_SIDE and side % 8 == 0 for side in (width, height)):
            raise ValueRangeError(
                f"eye network: found crops of {width} x {height}, expected multiples of 8 from 16 to {_MOST_SIDE}"
            )
        if len(channels) != 3 or not all(1 <= count <= _MOST_CHANNELS for count in (*channels, hidden)):
            raise ValueRangeError(f"channels: found {channels} and {hidden}, expected three and one, 1 to 256 each")
        if len(blocks) != 3 or not all(0 <= count <= _MOST_BLOCKS for count in blocks):
            raise ValueRangeError(f"blocks: found {blocks}, expected three numbers, 0 to {_MOST_BLOCKS} each")
        self.width, self.height = width, height
        self.channels, self.blocks, self.hidden = tuple(channels), tuple(blocks), hidden
        half, quarter, eighth = channels
        self.stem = nn.Sequential(convolution(3, half, 2), *[ResidualBlock(half) for _ in range(blocks[0])])
        self.quarter = nn.Sequential(convolution(half, quarter, 2), *[ResidualBlock(quarter) for _ in range(blocks[1])])
        self.eighth = nn.Sequential(convolution(quarter, eighth, 2), *[ResidualBlock(eighth) for _ in range(blocks[2])])
        self.context = nn.Linear(eighth, eighth)
        self.up_quarter, self.mix_quarter = nn.Conv2d(eighth, quarter, 1), convolution(quarter, quarter)
        self.up_half, self.mix_half = nn.Conv2d(quarter, half, 1), convolution(half, half)
        self.heat = nn.Conv2d(half, POINTS, 1)
        self.local = nn.Parameter(torch.zeros(POINTS, half))
        self.local_bias = nn.Parameter(torch.zeros(POINTS))
        self.told = nn.Sequential(nn.Linear(eighth + POINTS * half, hidden), nn.ReLU(), nn.Linear(hidden, 3))

    @classmethod
    def _usual_settings(cls) -> DescentSettings:
        from torchface.landmarks.images.networks.eye_training import EyeSettings

        return EyeSettings()

    def _task(self, pictures: Dataset[Any], settings: Any, device: str | torch.device) -> DescentTask[Any]:
        from torchface.landmarks.images.networks.eye_training import eye_task

        return eye_task(self, pictures, settings, device)

    def forward(self, crops: Tensor) -> EyeFindings:
        """What crops show, (B,3,h,w) in [0,1], red first.

        Raises:
            ShapeError: another shape.
        """
        if crops.ndim != 4 or crops.shape[1:] != (3, self.height, self.width):
            raise ShapeError(f"crops: found {tuple(crops.shape)}, expected (B,3,{self.height},{self.width})")
        return self.read(*self.maps(crops))

    def maps(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Heat maps (B,7,h/2,w/2), decoder features (B,C,h/2,w/2) and those of the whole crop (B,C')."""
        half = self.stem(evened(crops))
        quarter = self.quarter(half)
        deep = self.eighth(quarter)
        pooled = deep.mean((2, 3))
        deep = deep + self.context(pooled)[:, :, None, None]
        quarter = self.mix_quarter(doubled(self.up_quarter(deep)) + quarter)
        features = self.mix_half(doubled(self.up_half(quarter)) + half)
        return self.heat(features), features, pooled

    def read(self, heat: Tensor, features: Tensor, pooled: Tensor) -> EyeFindings:
        """Findings from what ``maps`` gives."""
        points, under, widening = read_heat(heat, features, STRIDE)
        deviation = ((under * self.local).sum(2) + self.local_bias + widening).exp()
        openness, closed, visibility = self.told(torch.cat([pooled, under.flatten(1)], dim=1)).unbind(1)
        return EyeFindings(
            points[:, :6], points[:, 6], deviation.clamp(*DEVIATION_RANGE), openness, closed.sigmoid(),
            visibility.sigmoid(),
        )  # fmt: skip


def evened(crops: Tensor) -> Tensor:
    """Crops (B,3,h,w) in [0,1] moved and scaled to a mean of 0 and a standard deviation of about 1."""
    centred = crops - crops.mean((1, 2, 3), keepdim=True)
    return centred / (centred.square().mean((1, 2, 3), keepdim=True) + LEAST_SPREAD**2).sqrt()
