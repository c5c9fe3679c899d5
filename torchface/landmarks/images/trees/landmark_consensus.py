"""Landmarks that trees find from several starts round one box: where they agree, and by how much they do not."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.face_reading import confidence_of
from torchface.landmarks.images.ibug_68 import MIRROR_68
from torchface.landmarks.images.trees.landmark_trees import LandmarkTrees, initial_shapes

REACH = 1.1  # how far the image that trees are shown reaches from the middle of a box, in its sides

_OUTLYING = 0.02  # of the box's side: starts that end so far from the others count half
_MAX_SIDE = 4096


@dataclass(frozen=True)
class ConsensusSettings:
    """From where trees start."""

    # How many, an even number; half of them on the mirrored image. Their mean is steadier than any of them, and knows
    # no side.
    starts: int = 16
    side: int = 110  # pixels a side that the box is given in the image that the trees see
    translation: float = 0.04  # standard deviation of the starts' place, of the box
    scale: float = 0.06  # standard deviation of the logarithm of their size
    rotation: float = 4.0  # standard deviation of their tilt, degrees
    seed: int = 0  # draws them, once for all images

    def __post_init__(self) -> None:
        if not (2 <= self.starts <= 4096 and self.starts % 2 == 0 and 16 <= self.side <= 1024):
            raise ValueRangeError(
                f"consensus: found {self.starts} starts, side {self.side}; expected 2 to 4096 and even, 16 to 1024"
            )
        if not all(0 <= value < 45 for value in (self.translation, self.scale, self.rotation)):
            raise ValueRangeError(f"consensus: found {self}, expected deviations from 0")


class Consensus(NamedTuple):
    """Landmarks, and how much the starts disagree about each."""

    landmarks: Tensor  # (L,2), pixels
    dispersion: Tensor  # (L,), root mean square distance of the starts' landmarks, of the box's side

    @property
    def confidence(self) -> Tensor:
        """(L,) in [0,1]: one half where starts disagree by 0.02 of the box's side."""
        return confidence_of(self.dispersion)


def consensus(
    trees: LandmarkTrees, image: Tensor, box: Tensor, tilt: float = 0.0, settings: ConsensusSettings | None = None
) -> Consensus:
    r"""Landmarks of one face in a grey image, uint8 (H,W), the robust mean over several starts.

    The face is cut out and brought to one size first, so that large images cost no more than small ones and no
    pixels are skipped. A start k counts for landmark l with the weight :math:`1 / (1 + (d_{kl} / d_0)^2)`,
    :math:`d_{kl}` its distance from the starts' median.

    Args:
        box: x, y, width, height of the face, (4,) pixels; it may reach out of the image.
        tilt: of the face, radians, clockwise as the image is seen.
    """
    settings = settings or ConsensusSettings()
    if image.ndim != 2 or image.dtype != torch.uint8:
        raise ShapeError(f"image: found {image.dtype} {tuple(image.shape)}, expected uint8 (H,W)")
    if len(trees.mean) != len(MIRROR_68):
        raise ShapeError(f"trees: found a model of {len(trees.mean)} landmarks, expected iBUG's {len(MIRROR_68)}")
    if box.shape != (4,):
        raise ShapeError(f"box: found {tuple(box.shape)}, expected (4,)")
    side = math.sqrt(max(float(box[2] * box[3]), 0.0)) if bool(torch.isfinite(box).all()) else 0.0
    if not 1 <= side <= _MAX_SIDE:
        raise ValueRangeError(f"box: found {box.tolist()}, expected a face of 1 to {_MAX_SIDE} pixels")
    resized, scale, corner = _cut(image.cpu().numpy(), box, side, settings.side)
    piece = torch.from_numpy(resized)[None, None].to(trees.mean) / 255
    middle = ((box[:2] + box[2:] / 2).to(trees.mean) + 0.5 - corner.to(trees.mean)) * scale.to(trees.mean) - 0.5
    starts = _starts(trees.mean, middle, settings, tilt)
    mirrored_pair = torch.cat([one.expand(len(starts), -1, -1, -1) for one in (piece, piece.flip(-1))])
    last = piece.shape[-1] - 1
    shapes = trees.refine(mirrored_pair, torch.cat([starts, _mirrored(starts, last)]))
    shapes = torch.cat([shapes[: len(starts)], _mirrored(shapes[len(starts) :], last)])
    shapes = (shapes + 0.5) / scale.to(shapes) + corner.to(shapes) - 0.5
    median = shapes.median(0).values
    distance = (shapes - median).norm(dim=-1, keepdim=True) / side
    weight = 1 / (1 + (distance / _OUTLYING).square())
    mean = (shapes * weight).sum(0) / weight.sum(0)
    return Consensus(mean, ((shapes - mean) / side).square().sum(-1).mean(0).sqrt())


def _cut(grey: np.ndarray, box: Tensor, side: float, wanted: int) -> tuple[np.ndarray, Tensor, Tensor]:
    """The image round a box at the wanted size, pixels of it a pixel (2,), and the corner it was cut at (2,)."""
    middle = (box[:2] + box[2:] / 2).tolist()
    reach = REACH * side
    x, y = math.floor(middle[0] - reach), math.floor(middle[1] - reach)
    count = math.ceil(2 * reach) + 1
    height, width = grey.shape
    columns = np.clip(np.arange(x, x + count), 0, width - 1)
    rows = np.clip(np.arange(y, y + count), 0, height - 1)
    piece = np.ascontiguousarray(grey[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])
    before = (int((rows == rows[0]).sum()) - 1, int((columns == columns[0]).sum()) - 1)
    after = (count - before[0] - len(piece), count - before[1] - piece.shape[1])
    if max(*before, *after) > 0:
        piece = cv2.copyMakeBorder(piece, before[0], after[0], before[1], after[1], cv2.BORDER_REPLICATE)
    size = max(2, round(count * wanted / side))
    method = cv2.INTER_AREA if size < count else cv2.INTER_LINEAR
    resized = cv2.resize(piece, (size, size), interpolation=method)
    return resized, torch.full((2,), size / count), torch.tensor([float(x), float(y)])


def _starts(mean: Tensor, middle: Tensor, settings: ConsensusSettings, tilt: float) -> Tensor:
    """The mean shape (L,2) round a middle (2,), moved, turned and scaled: (K/2,L,2)."""
    drawn = torch.randn(settings.starts // 2, 4, generator=torch.Generator().manual_seed(settings.seed)).clamp(-2, 2)
    drawn = (drawn - drawn.mean(0)).to(mean)
    angle = tilt + math.radians(settings.rotation) * drawn[:, 3]
    scale = (settings.scale * drawn[:, 2]).exp()
    rotation = (
        torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], 1).view(-1, 2, 2) * scale[:, None, None]
    )
    side = float(settings.side)
    square = torch.cat([middle - side / 2, middle.new_tensor([side, side])])[None]
    shape = initial_shapes(mean, square)[0]
    centre = shape.mean(0)
    turn = shape.new_tensor([[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]])
    shape, centre = shape - centre, middle + turn @ (centre - middle)  # the face turns about the middle of its box
    return centre + shape @ rotation.transpose(1, 2) + (settings.translation * side * drawn[:, :2])[:, None]


def _mirrored(shapes: Tensor, last: int) -> Tensor:
    """Shapes (K,L,2) in the mirrored image, whose last column is ``last``."""
    across = shapes[:, list(MIRROR_68)].clone()
    across[..., 0] = last - across[..., 0]
    return across
