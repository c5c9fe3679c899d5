"""Parts of the face in a photograph whose landmarks are known: skin, hair, brows, eyes, glasses, hands, cloth."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from torchface.landmarks.images.face_crop import crop_transform, cut_crop
from torchface.landmarks.images.graph_session import graph_session
from torchface.landmarks.images.ibug_68 import turned_box
from torchface.landmarks.images.networks.part_network import PART_MARGIN, PART_SIZE, PARTS

_GREY_HAIR = 0.25  # of its brightness, by which the channels of grey hair differ at most
_ROW = {name: number for number, name in enumerate(PARTS)}


@dataclass(frozen=True, eq=False)
class FaceParts:
    """What a crop of a picture shows."""

    shares: Tensor  # of each of PARTS in the crop's pixels, (10,S,S)
    transform: Tensor  # from the picture's pixels to the crop's, (2,3) float64

    def crop(self, image: Tensor) -> Tensor:
        """The crop (3,S,S) of the picture (3,H,W) in [0,1]."""
        return cut_crop((255 * image[:3].clamp(0, 1)).byte(), self.transform, self.shares.shape[-1]).float() / 255

    def in_crop(self, pixels: Tensor) -> Tensor:
        """Pixels (...,2) of the picture as pixels of the crop, float64."""
        return pixels.double() @ self.transform[:, :2].T + self.transform[:, 2]

    def of(self, *names: str) -> Tensor:
        """The share of some of :data:`PARTS` together in the crop's pixels, (S,S)."""
        return self.shares[[_ROW[name] for name in names]].sum(0)

    def at(self, pixels: Tensor, *names: str) -> Tensor:
        """The share of some of :data:`PARTS` together at pixels (...,2) of the picture, (...); NaN beyond the crop."""
        values, inside = self._shares(pixels, *names)
        return torch.where(inside, values, torch.nan)

    def around(self, pixels: Tensor, *names: str) -> Tensor:
        """As ``at``; beyond the crop that of its edge nearby."""
        return self._shares(pixels, *names)[0]

    def _shares(self, pixels: Tensor, *names: str) -> tuple[Tensor, Tensor]:
        place = self.in_crop(pixels)
        size = self.shares.shape[-1]
        grid = ((2 * place + 1) / size - 1).to(self.shares)
        values = grid_sample(
            self.of(*names)[None, None], grid.reshape(1, 1, -1, 2), padding_mode="border", align_corners=False
        ).reshape(place.shape[:-1])
        return values, (grid.abs() <= 1).all(-1)


@dataclass(frozen=True, eq=False)
class PartFinder:
    """Shows a network the upright crop of a face, and its mirror image."""

    # From crops (B,3,S,S) float32 in [0,1], red first, to shares (B,10,S,S) of PARTS.
    network: Callable[[Tensor], Tensor]

    @torch.no_grad()
    def __call__(self, image: Tensor, landmarks: Tensor) -> FaceParts:
        """The parts of the face with these landmarks, (68,2) pixels; NaN for missing."""
        known = landmarks.float()
        known = torch.where(known.isfinite(), known, known[known.isfinite().all(-1)].mean(0))
        box, tilt = turned_box(known)
        transform = crop_transform(box, float(tilt), PART_SIZE, PART_MARGIN)
        crop = cut_crop(image, transform, PART_SIZE).float() / 255
        both = self.network(torch.stack([crop, crop.flip(-1)]))
        found = FaceParts((both[0] + both[1].flip(-1)) / 2, transform)
        return replace(found, shares=_with_grey_hair(found.shares, crop, float(found.in_crop(known[30])[1])))


def _with_grey_hair(shares: Tensor, crop: Tensor, nose: float) -> Tensor:
    """Shares (10,S,S) of a crop (3,S,S) in which what is cloth without a hue over the nose's tip is hair.

    The network takes grey hair for cloth; a grey hat is hair then, of its colour.
    """
    grey = crop.amax(0) - crop.amin(0) < _GREY_HAIR * crop.mean(0)
    over = torch.arange(crop.shape[1])[:, None] < nose
    moved = shares[_ROW["cloth"]] * (grey & over)
    shares = shares.clone()
    shares[_ROW["hair"]] += moved
    shares[_ROW["cloth"]] -= moved
    return shares


def graph_part_finder(content: bytes) -> PartFinder:
    """The finder of a part network's graph, in ONNX Runtime on one thread."""
    session = graph_session(content)
    return PartFinder(lambda crops: torch.from_numpy(session.run(["shares"], {"faces": crops.contiguous().numpy()})[0]))
