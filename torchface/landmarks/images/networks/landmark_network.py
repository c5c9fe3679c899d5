"""68 landmarks of a face in one pass of a small convolutional network: places, their uncertainty, what is hidden."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from torchface.errors import ShapeError, ValueRangeError
from torchface.files.documents import Value
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.networks.heat_maps import ResidualBlock, convolution, doubled, read_heat
from torchface.progress import Progress, ValueLog

if TYPE_CHECKING:
    from torchface.landmarks.images.networks.landmark_training import NetworkSettings

STRIDE = 4
"""Pixels of the crop a side of a heat map's cell."""
_MOST_CHANNELS, _MOST_BLOCKS, _MOST_SIZE = 512, 16, 512
DEVIATION_RANGE = (0.05, 60.0)
"""Pixels of the crop, of the deviations that the network states."""


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

    with :math:`h_l` the heat map of landmark l at a quarter of the crop's resolution. Features under the heat map give
    the deviation to be expected of the landmark, and whether something hides it.

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

    @classmethod
    def fit(
        cls,
        pictures: Dataset[tuple[Tensor, ...]],
        network: LandmarkNetwork | None = None,
        settings: NetworkSettings | None = None,
        progress: Progress | None = None,
        checkpoint: Path | None = None,
        device: str | torch.device = "cpu",
        log: ValueLog | None = None,
    ) -> LandmarkNetwork:
        r"""Trains a landmark network on pictures.

        .. math:: \sum_l v_l \Bigl( r_l + 3 \ln(1 + r_l / 0.7) + \tfrac{r_l}{2 \sigma_l} + \ln \sigma_l \Bigr)
            + \text{distances of pairs} + \text{form of heat maps} + \text{cross entropy of } v \text{ and presence}

        with :math:`r_l` the distance from the truth in pixels of the crop.

        Args:
            pictures: indexed by numbers (B,), such as ``TensorDataset(rgba, landmarks, visible)``; each batch is asked
                for by a ``DataLoader``'s workers. Gives cut-out faces, uint8 (B,4,H,W), see
                ``train/rendered_people/face_picture.py``; iBUG's 68, (B,68,2) pixels; and which of them nothing hides,
                (B,68) bool.
            network: goes on from its weights; a new one if absent.
            settings: how.
            progress: called with each step and how far it is.
            checkpoint: a file that is kept while it runs, and taken up by the next run with the same settings; more
                pictures may have come by then.
            device: where the network computes.
            log: called with what was measured, every fifty steps.

        Returns:
            The running mean of the weights, in evaluation mode, on the CPU.

        Raises:
            ShapeError: no picture, or other shapes.

        Source: Feng et al. 2018 (a loss that is steep near zero); Kumar et al. 2020 (likelihood with visibility).
        """
        from torchface.landmarks.images.networks.landmark_training import fit_landmarks

        return fit_landmarks(pictures, network, settings, progress, checkpoint, device, log)

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
        points, under, widening = read_heat(heat, features, STRIDE)
        local = (under[..., None] * self.local).sum(2) + self.local_bias
        deviation = (local[..., 0] + widening).exp()
        return NetworkLandmarks(points, deviation.clamp(*DEVIATION_RANGE), local[..., 1].sigmoid(), presence.sigmoid())
