"""Head of the landmark network that reads many points of the face's surface, and the weights of its expression."""

from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from torchface.landmarks.images.ibug_68 import COUNT, tilt_around
from torchface.shape_names import ARKIT

WEIGHTS = len(ARKIT)

_OWN, _SHARED, _UNDER = 3, 2, 8  # numbers read off the features of a point: its own, and those that all others see
_CELLS, _DEEP, _EXTENT = (
    6,
    4,
    1.8,
)  # deep features: cells a side, numbers of a cell, and half the side, of a face's size
_FORM, _MOVE, _SURE, _SEEN = 56, 88, 16, 64  # ranks of maps to all points, and units that see where points were found
_OFFSET = 0.1  # of the face's size, a unit of what features move a point by


class DenseReading(NamedTuple):
    """What the head reads of B faces."""

    points: Tensor  # (B,P,2) pixels of the crop
    point_deviation: Tensor  # standard deviation of a coordinate, (B,P) pixels
    expression: Tensor  # weights by ARKit's names as they are to be expected, (B,52)
    expression_deviation: Tensor  # standard deviation of the truth about them, (B,52)


class DenseHead(nn.Module):
    r"""Points of the face's surface, and weights of blendshapes, from iBUG's 68 landmarks and features at a quarter.

    .. math:: x_p = \bar x_p + F_p g + A_p f(\bar x_p + F_p g) + B_p h

    with g the 68 landmarks in the face's own frame, f the features under a place, and h hidden units that see g, the
    features under all landmarks and points, the deepest features on a grid in the face's frame, and their mean. Weights
    are read off h and off where points were found.

    Source: Wood et al. 2022 (many points with a deviation each, from rendered pictures).
    """

    places: Tensor
    mirror: Tensor
    cells: Tensor
    spread: Tensor

    def __init__(self, points: int, hidden: int, channels: int, deep: int) -> None:
        super().__init__()
        self.register_buffer("places", torch.zeros(points, 3))
        self.register_buffer("mirror", torch.arange(points, device="cpu"))
        self.register_buffer("spread", torch.ones(WEIGHTS))  # errors of weights in stated deviations, of held-out faces
        cells = _EXTENT * torch.linspace(-1, 1, _CELLS, device="cpu")
        self.register_buffer("cells", torch.cartesian_prod(cells, cells).flip(1))
        rank = min(_FORM, 2 * points)
        self.form = nn.Sequential(nn.Linear(2 * COUNT, rank, bias=False), nn.Linear(rank, 2 * points))
        self.local = _normal(0.05, points, channels, _OWN + _SHARED)
        self.under = _normal(0.1, COUNT, channels, _UNDER)
        self.deep = _normal(0.1, _CELLS**2, deep, _DEEP)
        self.mix = nn.Linear(2 * COUNT + COUNT * _UNDER + points * _SHARED + deep + _CELLS**2 * _DEEP, hidden)
        self.again = nn.Linear(hidden, hidden)
        self.move = nn.Sequential(nn.Linear(hidden, _MOVE, bias=False), nn.Linear(_MOVE, 2 * points, bias=False))
        self.sure = nn.Sequential(nn.Linear(hidden, _SURE, bias=False), nn.Linear(_SURE, points))
        self.seen = nn.Linear(2 * COUNT + 2 * points + hidden, _SEEN)
        self.weights = nn.Linear(hidden, 2 * WEIGHTS)
        self.more = nn.Linear(_SEEN, 2 * WEIGHTS, bias=False)
        nn.init.zeros_(self._form()[1].bias)
        nn.init.zeros_(self.more.weight)
        nn.init.constant_(cast(nn.Linear, self.sure[1]).bias, -2.0)  # a seventh of the face's size

    def forward(self, landmarks: Tensor, under: Tensor, features: Tensor, deep: Tensor, size: int) -> DenseReading:
        """What is read of landmarks (B,68,2), crop's pixels, features under them (B,68,C), all features and the
        deepest.
        """
        middle, axes = face_frame(landmarks)
        own = in_face_frame(landmarks, landmarks).flatten(1)
        base = self.form(own).unflatten(1, (-1, 2))
        local = _each(_sampled(features, base @ axes + middle, size), self.local)
        cells = _each(_sampled(deep, self.cells @ axes + middle, size), self.deep)
        shared = [_each(under, self.under), local[..., _OWN:]]
        read = [own, *(one.flatten(1) for one in shared), deep.mean((2, 3)), cells.flatten(1)]
        hidden = torch.relu(self.mix(torch.cat(read, 1)))
        hidden = hidden + torch.relu(self.again(hidden))
        apart = local[..., :2] + self.move(hidden).unflatten(1, (-1, 2))
        moved = base + _OFFSET * apart
        deviation = (local[..., 2] + self.sure(hidden)).clamp(-8, 4).exp() * axes[:, :1].norm(dim=2)
        seen = torch.relu(self.seen(torch.cat([own, apart.flatten(1), hidden], 1)))
        weights, logarithm = (self.weights(hidden) + self.more(seen)).split(WEIGHTS, 1)
        stated = self.spread * (logarithm - 2).clamp(-5, 2).exp()
        return DenseReading(moved @ axes + middle, deviation, weights, stated)

    @torch.no_grad()
    def start_form(self, matrix: Tensor, base: Tensor, own: Tensor) -> None:
        """Has points (2P,) begin as ``base`` + the part of ``matrix`` (2P,136) of its rank @ (landmarks - ``own``)."""
        narrow, wide = self._form()
        left, values, right = torch.linalg.svd(matrix, full_matrices=False)
        root = values[: narrow.out_features].sqrt()
        narrow.weight.copy_(root[:, None] * right[: len(root)])
        wide.weight.copy_(left[:, : len(root)] * root)
        wide.bias.copy_(base - wide.weight @ (narrow.weight @ own))

    @property
    def started(self) -> bool:
        """Whether points have a form to begin with, by :meth:`start_form` or by learning."""
        return bool(self._form()[1].bias.any())

    def _form(self) -> tuple[nn.Linear, nn.Linear]:
        return cast(nn.Linear, self.form[0]), cast(nn.Linear, self.form[1])

    @torch.no_grad()
    def calibrate(self, expression: Tensor, deviation: Tensor, truth: Tensor) -> None:
        """Measures errors in stated deviations of faces of people that were not learned from, (M,52) each."""
        self.spread.copy_(((expression - truth) / (deviation / self.spread)).square().mean(0).sqrt())


def face_frame(landmarks: Tensor) -> tuple[Tensor, Tensor]:
    """The middle (B,1,2) of landmarks (B,68,2), and the face's own axes (B,2,2) in pixels: to the left eye, and down.

    An axis is as long as the landmarks are distant from their middle in the root mean square.
    """
    middle = landmarks.mean(1, keepdim=True)
    size = (landmarks - middle).square().sum(-1).mean(1).clamp(min=1e-4).sqrt()
    tilt = tilt_around(landmarks)
    cosine, sine = size * tilt.cos(), size * tilt.sin()
    # Without a constant tensor, which a branch of an exported graph cannot hold.
    return middle, torch.stack([cosine, sine, -sine, cosine], -1).unflatten(-1, (2, 2))


def in_face_frame(points: Tensor, landmarks: Tensor) -> Tensor:
    """Points (B,L,2) of faces with landmarks (B,68,2), in the faces' own frames."""
    middle, axes = face_frame(landmarks)
    return (points - middle) @ axes.transpose(1, 2) / axes.square().sum(2)[:, None]


def _normal(deviation: float, *shape: int) -> nn.Parameter:
    """Normally distributed numbers; on "meta" none: what computes there loads torch's compiler, two seconds."""
    empty = torch.empty(shape)
    return nn.Parameter(empty if empty.is_meta else empty.normal_(std=deviation))


def _sampled(features: Tensor, pixels: Tensor, size: int) -> Tensor:
    """Features (B,C,h,w) of crops of ``size`` pixels a side at places (B,L,2), (B,L,C)."""
    height, width = features.shape[2:]
    places = ((pixels + 0.5) * (width / size) - 0.5).unbind(-1)
    inside = [
        torch.where(one > 0, one, 0.0).clamp(max=side - 1) for one, side in zip(places, (width, height), strict=True)
    ]
    x, y = (one.clamp(max=side - 2).long() for one, side in zip(inside, (width, height), strict=True))
    right, down = ((one - low)[..., None] for one, low in zip(inside, (x, y), strict=True))
    # Rows of a table: ONNX Runtime samples a grid in five times the time.
    table = features.flatten(2).transpose(1, 2).flatten(0, 1)
    first = x + width * y + (height * width) * torch.arange(features.shape[0], device=x.device)[:, None]
    a, b, c, d = (table[(first + beside).flatten()].unflatten(0, x.shape) for beside in (0, 1, width, width + 1))
    return torch.lerp(torch.lerp(a, b, right), torch.lerp(c, d, right), down)


def _each(features: Tensor, rows: Tensor) -> Tensor:
    """Products (B,L,K) of features (B,L,C) with rows (L,C,K) of their own."""
    return torch.bmm(features.transpose(0, 1), rows).transpose(0, 1)
