"""Landmarks of a face in one pass of a small convolutional network, and with a head for it points of the whole face."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.networks.dense_head import WEIGHTS, DenseHead, DenseReading
from torchface.landmarks.images.networks.heat_maps import ResidualBlock, convolution, doubled, read_heat
from torchface.landmarks.images.networks.picture_network import PictureNetwork
from torchface.optim import DescentSettings, DescentTask

STRIDE = 4  # pixels of the crop a side of a heat map's cell
_MOST_CHANNELS, _MOST_BLOCKS, _MOST_SIZE, _MOST_POINTS = 512, 16, 512, 4096
DEVIATION_RANGE = (0.05, 60.0)  # pixels of the crop, of the deviations that the network states


class NetworkLandmarks(NamedTuple):
    """What the network finds in B crops.

    Args:
        landmarks: iBUG's 68, (B,68,2) pixels of the crop, whose centres are at integers.
        deviation: mean distance to be expected of each from the truth, (B,68) pixels of the crop.
        visibility: probability that nothing stands before it, (B,68).
        presence: probability that the crop shows a face in the place it expects, (B,).
        points: the network's other points, (B,P,2) pixels of the crop.
        point_deviation: standard deviation of a coordinate of each, (B,P) pixels: large where a point is hidden.
        expression: weights of blendshapes by ARKit's names as they are to be expected, (B,52): their usual means where
            nothing is seen; NaN of a network without points.
        expression_deviation: standard deviation of the truth about them, (B,52).
    """

    landmarks: Tensor
    deviation: Tensor
    visibility: Tensor
    presence: Tensor
    points: Tensor
    point_deviation: Tensor
    expression: Tensor
    expression_deviation: Tensor

    @classmethod
    def of_68(cls, landmarks: Tensor, deviation: Tensor, visibility: Tensor, presence: Tensor) -> "NetworkLandmarks":
        """What is found by a network without further points."""
        count = landmarks.shape[:1]
        points = landmarks.new_zeros((*count, 0, 2)), landmarks.new_zeros((*count, 0))
        unseen = (landmarks.new_full((*count, WEIGHTS), value) for value in (torch.nan, torch.inf))
        return cls(landmarks, deviation, visibility, presence, *points, *unseen)


class LandmarkNetwork(PictureNetwork):
    r"""Landmarks by a convolutional encoder and decoder whose heat maps are read by their means.

    .. math:: x_l = \sum_p \mathrm{softmax}(h_l)_p \, p

    with :math:`h_l` the heat map of landmark l at a quarter of the crop's resolution. Features under the heat map give
    the deviation to be expected of the landmark, and whether something hides it. With points it has a ``DenseHead``.

    Args:
        size: of a crop, pixels a side; a multiple of 16.
        margin: a crop's side, of the side of the face's box as ``box_around`` draws it.
        channels: at a half, a quarter, an eighth and a sixteenth of the resolution.
        blocks: residual blocks at a quarter, an eighth and a sixteenth.
        decoder: channels of the decoder at a quarter.
        points: P, how many points of the face it finds beside the 68: where they are, ``places`` has.
        hidden: units of the head that finds them and reads the expression.

    :meth:`fit` takes cut-out faces, uint8 (B,4,H,W), see ``train/rendered_people/face_picture.py``; iBUG's 68, (B,68,2)
    pixels; and which of them nothing hides, (B,68) bool. For a network with points also these, (B,P,2) and (B,P) bool,
    and the weights of blendshapes by ARKit's names that are posed, (B,52). It minimises, with :math:`r_l` the distance
    from the truth in pixels of the crop,

    .. math:: \sum_l v_l \Bigl( r_l + 3 \ln(1 + r_l / 0.7) + \tfrac{r_l}{2 \sigma_l} + \ln \sigma_l \Bigr)
        + \text{distances of pairs} + \text{openings} + \text{form of heat maps}
        + \text{cross entropy of } v \text{ and presence} + \text{likelihood of points and weights}

    Source: Newell, Yang, Deng 2016 (encoder and decoder); Sun et al. 2018 (means of heat maps); Kumar et al. 2020
    (uncertainty and visibility beside places); Feng et al. 2018 (a loss that is steep near zero).

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
        points: int = 0,
        hidden: int = 176,
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
        if not (0 <= points <= _MOST_POINTS and 1 <= hidden <= _MOST_CHANNELS):
            raise ValueRangeError(
                f"points: found {points} and {hidden} hidden units, expected 0 to {_MOST_POINTS} and 1 to "
                f"{_MOST_CHANNELS}"
            )
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
        self.points, self.hidden = points, hidden
        self.dense = DenseHead(points, hidden, decoder, sixteenth) if points else None

    @classmethod
    def _usual_settings(cls) -> DescentSettings:
        from torchface.landmarks.images.networks.landmark_training import NetworkSettings

        return NetworkSettings()

    def _task(self, pictures: Dataset[Any], settings: Any, device: str | torch.device) -> DescentTask[Any]:
        from torchface.landmarks.images.networks.landmark_training import landmark_task

        return landmark_task(self, pictures, settings, device)

    @property
    def places(self) -> Tensor:
        """Where its points are on the embedded performer's sculpture, (P,3) millimetres."""
        return torch.zeros(0, 3) if self.dense is None else self.dense.places

    @property
    def mirror(self) -> Tensor:
        """Which of its points each becomes when the picture is mirrored, (P,) int64."""
        return torch.zeros(0, dtype=torch.int64) if self.dense is None else self.dense.mirror

    def with_points(
        self, places: Tensor, mirror: Tensor, hidden: int = 176, size: int | None = None
    ) -> "LandmarkNetwork":
        """A network that finds the 68 as this one does, and has an untrained head for further points.

        Args:
            places: of the points on the embedded performer's sculpture, (P,3) millimetres.
            mirror: which of them each becomes when the picture is mirrored, (P,) int64.
            hidden: units of the head.
            size: of its crops, pixels a side; as this one's if absent. Of crops of another size it is to learn first.
        """
        config = {"points": len(places), "hidden": hidden, "size": size or self.size}
        network = LandmarkNetwork.from_config(self.config | config)
        own = {name: value for name, value in self.state_dict().items() if not name.startswith("dense.")}
        network.load_state_dict(network.state_dict() | own)
        assert network.dense is not None
        network.dense.places.copy_(places)
        network.dense.mirror.copy_(mirror)
        return network

    def resized(self, size: int) -> "LandmarkNetwork":
        """This network with crops of another size, pixels a side, of which it is to learn first."""
        network = LandmarkNetwork.from_config(self.config | {"size": size})
        network.load_state_dict(self.state_dict())
        return network.train(self.training)

    def forward(self, crops: Tensor) -> NetworkLandmarks:
        """Landmarks in crops, (B,3,S,S) in [0,1], red first.

        Raises:
            ShapeError: another shape.
        """
        if crops.ndim != 4 or crops.shape[1:] != (3, self.size, self.size):
            raise ShapeError(f"crops: found {tuple(crops.shape)}, expected (B,3,{self.size},{self.size})")
        return self.read(*self.maps(crops))

    def maps(self, crops: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Heat maps (B,68,S/4,S/4), decoder features (B,C,S/4,S/4) and the deepest features (B,D,S/16,S/16)."""
        quarter = self.quarter(self.stem(2 * crops - 1))
        eighth = self.eighth(quarter)
        deep = self.sixteenth(eighth)
        whole = deep + self.context(deep.mean((2, 3)))[:, :, None, None]
        eighth = self.mix_eighth(doubled(self.up_eighth(whole)) + eighth)
        features = self.mix_quarter(doubled(self.up_quarter(eighth)) + self.skip_quarter(quarter))
        return self.heat(features), features, deep

    def read(self, heat: Tensor, features: Tensor, deep: Tensor) -> NetworkLandmarks:
        """Landmarks from what ``maps`` gives."""
        found, dense = self.readings(heat, features, deep)
        return found if dense is None else NetworkLandmarks(*found[:4], *dense)

    def readings(self, heat: Tensor, features: Tensor, deep: Tensor) -> tuple[NetworkLandmarks, DenseReading | None]:
        """The 68 alone, and what the head for points reads; None without one."""
        points, under, widening = read_heat(heat, features, STRIDE)
        local = (under[..., None] * self.local).sum(2) + self.local_bias
        deviation = (local[..., 0] + widening).exp().clamp(*DEVIATION_RANGE)
        presence = self.presence(deep.mean((2, 3)))[:, 0].sigmoid()
        found = NetworkLandmarks.of_68(points, deviation, local[..., 1].sigmoid(), presence)
        if self.dense is None:
            return found, None
        # The head describes where the 68 are; it does not move them.
        dense = self.dense(points.detach(), under, features, deep, self.size)
        return found, dense._replace(point_deviation=dense.point_deviation.clamp(*DEVIATION_RANGE))
