"""Hair as a cap of its colour in the photographs: paint on the head, no geometry."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.modeling.photographs.skin_mask import FacePlaces, ramp
from torchface.rendering.camera_visibility import Shown

# In distances between the eyes' outer corners, about the middle between them: how high hair begins over the face's
# middle and how it falls toward the temples; from where to where before the ears' front it comes down to a sideburn and
# rises over the ears, and behind them falls to the neck, where it ends; that of hair that hangs down.
_HAIRLINE, _FALL, _TEMPLE = 0.76, 0.28, 0.7
_SIDES, _SIDEBURN = (-0.25, 0.05), 0.05
_EAR, _OVER_EARS = (0.08, 0.2), 0.14
_BEHIND, _NAPE = (0.54, 0.74), -0.75
_LONG_BEHIND, _LONG_NAPE = (0.48, 0.66), -1.5
_EDGE, _FRINGE = 0.08, 0.07
_ABOVE_BROWS, _SQUARE, _HAIR = 0.06, 0.3, 0.5
_DEEP, _SHARPLY = 5.0, 2  # pixels of the crop within hair, and the power with which they count
_LEAST, _SHARE = 20, 0.3
_EXTREME = 0.2  # share of hair in highlights, and in the deepest shade
_DYED = 0.2  # of full white, between the channels of dyed hair
_BEYOND, _MIDDLE = 0.2, 0.35  # share of hair in a picture above the brows, there about the face's middle
_COLUMNS, _COLUMN, _FEW = 17, 0.05, 6  # across the forehead, half the width of each, vertices
_MIDDLE_COLUMNS, _LOW_FRINGE = slice(5, 12), 0.2  # in which a fringe hangs so far below the usual hairline
_STEP, _REACH = 0.03, 0.3  # over which the slope of the line is taken, and how far the line counts
# Widths (radians about the crown's axis) and lengths of strands and of locks, the band over which hair grows thin, how
# uneven its edge is in that, and by how much strands differ in brightness.
_STRANDS, _LOCKS = (0.02, 0.25), (0.13, 0.4)
_THIN, _RAGGED, _CONTRAST = 0.26, 0.5, 0.35
# In distances between the eyes' outer corners: how far from the face's middle hair hangs beside the neck, and how far
# below the mouth.
_BESIDE, _BELOW = (0.55, 1.15), (0.15, 0.75)
_LONG = 0.25  # share of hair there on one side
_FAR = 0.5  # width of a turned face's far side beside the near one's
_TUFT = 30  # pixels of the crop


@dataclass(frozen=True, eq=False)
class HairCap:
    """Hair that photographs show."""

    color: Tensor  # sRGB, (3,)
    line: Tensor  # how high it begins over the face at places from the right temple to the left, (17,)
    places: FacePlaces
    long: bool = False  # whether it hangs down behind the ears

    @property
    def fringe(self) -> bool:
        """Whether it hangs over the forehead's middle."""
        across, line = (one[_MIDDLE_COLUMNS] for one in (_columns(), self.line))
        return float((_usual_line(across) - line).median()) > _LOW_FRINGE

    def share(self, place: Tensor) -> Tensor:
        """How much hair covers points (Q,) at places (Q,3)."""
        y, behind = place[:, 1], self.places.ears - place[:, 2]
        line, before, after, front, back = (
            self._line(place[:, 0], behind + step) for step in (0.0, -_STEP, _STEP, -_REACH, _REACH)
        )
        beyond = (y - line) / (1 + ((after - before) / (2 * _STEP)).square()).sqrt()
        # Where the line is steep the nearest of it lies beside, not below.
        beyond = torch.maximum(beyond, (y - torch.stack([line, front, back]).amax(0)).clamp(max=_REACH))
        # Hair grows thinner toward its edge, in locks of uneven length, until single strands are left on the skin.
        locks = _noise(self._way(place, *_LOCKS)) - 0.5
        thick = beyond / _THIN + _RAGGED * locks + 0.5
        strand = _noise(self._way(place, *_STRANDS))
        return ramp(thick, 0.0, 1.0) * ramp(thick + strand - 0.5, 0.0, 0.8)

    def _line(self, across: Tensor, behind: Tensor) -> Tensor:
        """How high hair begins at places (Q,) across the face and behind the ears' front, (Q,)."""
        column = (across / _TEMPLE).clamp(-1, 1) * ((_COLUMNS - 1) // 2) + (_COLUMNS - 1) // 2
        left = column.floor().long().clamp(max=_COLUMNS - 2)
        line = torch.lerp(self.line[left], self.line[left + 1], column - left)
        line = torch.lerp(line, torch.full_like(line, _SIDEBURN), ramp(behind, *_SIDES))
        line = torch.lerp(line, torch.full_like(line, _OVER_EARS), ramp(behind, *_EAR))
        where, low = (_LONG_BEHIND, _LONG_NAPE) if self.long else (_BEHIND, _NAPE)
        return torch.lerp(line, torch.full_like(line, low), ramp(behind, *where))

    def painted(self, colors: Tensor, place: Tensor, share: Tensor) -> Tensor:
        """Colours (Q,3) with the hair over them, in strands that hang down."""
        light = _noise(self._way(place, *_STRANDS)) + _noise(self._way(place, *_LOCKS)) - 1.0
        hair = self.color.to(colors) * (1 + _CONTRAST * light[:, None]).to(colors)
        return torch.lerp(colors, hair.clamp(0, 1), share[:, None].to(colors))

    def _way(self, place: Tensor, across: float, along: float) -> Tensor:
        """Places (Q,3) across and along the hair, which hangs down from the crown, in widths and lengths, (Q,2)."""
        around = torch.atan2(place[:, 0], place[:, 2] - self.places.ears)
        return torch.stack([around / across, place[:, 1] / along], dim=1)


def _noise(at: Tensor) -> Tensor:
    """Uneven values in [0,1] at places (Q,2), smooth over about 1."""
    cell = at.floor()
    share = at - cell
    share = share * share * (3 - 2 * share)
    values = [
        (43758.5453 * torch.sin((cell + cell.new_tensor(corner)) @ cell.new_tensor([12.9898, 78.233]))) % 1
        for corner in ((0, 0), (1, 0), (0, 1), (1, 1))
    ]
    low, high = (torch.lerp(values[k], values[k + 1], share[:, 0]) for k in (0, 2))
    return torch.lerp(low, high, share[:, 1])


def hair_cap(
    images: Sequence[Tensor],
    parts: Sequence[FaceParts],
    marks: Sequence[Tensor],
    shown: Sequence[Shown],
    places: Sequence[FacePlaces],
    hair: Tensor,
) -> HairCap | None:
    """The hair (I,V), see ``ShownParts``, that photographs (3,H,W) with landmarks (68,2) show above the brows, on the
    head that was found or off it; None without.
    """
    place, covered = _over_brows(shown, places, hair)
    high = place[:, 1] > _HAIRLINE - _FALL
    on_head = int((covered & high).sum()) >= max(_LEAST, _SHARE * int(high.sum()))
    color = _hair_color(images, parts, marks, on_head)
    if color is None:
        return None
    return HairCap(color, _hairline(place, covered), places[0], hangs_down(parts, torch.stack(list(marks))))


def _over_brows(shown: Sequence[Shown], places: Sequence[FacePlaces], hair: Tensor) -> tuple[Tensor, Tensor]:
    """Places (Q,2) that photographs show above the brows, and whether there is hair (Q,)."""
    at, found = list[Tensor](), list[Tensor]()
    for one, where, share in zip(shown, places, hair, strict=True):
        seen = (one.cosine > _SQUARE) & (where.place[:, 1] > where.brows + _ABOVE_BROWS) & (where.behind < _SIDES[0])
        at.append(where.place[seen, :2])
        found.append(share[seen] > _HAIR)
    return torch.cat(at), torch.cat(found)


def _hairline(place: Tensor, covered: Tensor) -> Tensor:
    """Where hair begins in each column of the forehead, (17,): the height that best parts skin below from hair above,
    so that a fringe is hair and no second pair of brows."""
    across = _columns()
    line = torch.stack([
        _line(place[near, 1], covered[near], height)
        for height, near in zip(_usual_line(across), (place[:, :1] - across).abs().T < _COLUMN, strict=True)
    ])  # fmt: skip
    around = lambda values: torch.cat([values[:1].expand(2), values, values[-1:].expand(2)]).unfold(0, 5, 1)  # noqa: E731
    return around(around(line).median(1).values).mean(1)


def _columns() -> Tensor:
    """Places across the forehead, (17,)."""
    return torch.linspace(-1, 1, _COLUMNS, dtype=torch.float64) * _TEMPLE


def _usual_line(across: Tensor) -> Tensor:
    """How high hair usually begins there."""
    return _HAIRLINE - _FALL * (across / _TEMPLE).square()


def _hair_color(
    images: Sequence[Tensor], parts: Sequence[FaceParts], marks: Sequence[Tensor], on_head: bool
) -> Tensor | None:
    """The mean colour (3,) of hair above the brows, without highlights and the deepest shade; None without.

    Where none is seen on the head that was found, it may stand off it, such as a shock of it.
    """
    colors, weights = [], []
    for image, shown, points in zip(images, parts, marks, strict=True):
        crop, size = shown.crop(image), shown.shares.shape[-1]
        at = shown.in_crop(points)
        top = int(at[17:27, 1].amin().clamp(0, size))
        share = shown.of("hair")[:top].double()
        hair, crop = share > _HAIR, crop[:, :top]
        middle = (torch.arange(size) - at[36:48, 0].mean()).abs() / (at[45] - at[36]).norm() < _MIDDLE
        seen = hair[:, middle].double().mean() if hair.numel() else torch.zeros(())
        if on_head or float(seen) > _BEYOND:
            # The border of hair is mixed with what stands behind it and with skin.
            inside = (_grown(shown, points, share) * hair).byte().numpy()
            weight = (
                torch.from_numpy(cv2.distanceTransform(inside, cv2.DIST_L2, 3)).clamp(max=_DEEP).double().pow(_SHARPLY)
            )
            colors.append(crop.double().flatten(1))
            weights.append(weight.flatten())
    if not weights or float(torch.cat(weights).sum()) < _LEAST:
        return None
    color, weight = torch.cat(colors, dim=1), torch.cat(weights)
    order = color.mean(0).argsort()
    total = weight[order].cumsum(0)
    usual = order[(total > _EXTREME * total[-1]) & (total <= (1 - _EXTREME) * total[-1])]
    color = (color[:, usual] @ weight[usual] / weight[usual].sum()).float()
    # Hair that is not dyed is never bluish: the light or the camera is.
    cast = bool(color[2] > color[0]) and float(color.amax() - color.amin()) < _DYED
    return color.mean().expand(3) if cast else color


def hangs_down(parts: Sequence[FaceParts], marks: Tensor) -> bool:
    """Whether photographs, with landmarks (I,68,2), show hair beside the neck that grows on the head.

    Of a face that is turned the near side counts: beside the other lies what stands behind the head.
    """
    found = []
    for shown, points in zip(parts, marks.double(), strict=True):
        across = points[42:48].nanmean(0) - points[36:42].nanmean(0)
        unit = across * (points[45] - points[36]).norm().nan_to_num(float(1.45 * across.norm())) / across.norm()
        down = torch.stack([-unit[1], unit[0]])
        sides = torch.linspace(*_BESIDE, 9, dtype=torch.float64)
        below = torch.linspace(*_BELOW, 9, dtype=torch.float64)
        mouth = points[48:].nanmean(0)
        grown = replace(shown, shares=shown.shares * _grown(shown, points, shown.of("hair")))
        left, right = (
            grown.at(mouth + side * sides[:, None, None] * unit + below[:, None] * down, "hair").nanmean().nan_to_num(0)
            for side in (-1, 1)
        )
        jaw = torch.stack([points[:3].nanmean(0), points[14:17].nanmean(0)])
        widths = ((points[30] - jaw) @ across).abs().nan_to_num(0.0)
        turned = [bool(widths[k] < _FAR * widths[1 - k]) for k in (0, 1)]
        found.append(right if turned[0] else left if turned[1] else torch.maximum(left, right))
    return float(torch.stack(found).median()) > _LONG


def _grown(shown: FaceParts, points: Tensor, share: Tensor) -> Tensor:
    """Which pixels of a crop's upper rows, (H,S), belong to hair, in shares (H,S), that is one with hair over the
    brows' middle, landmarks (68,2).

    What reaches over them beside the head alone is a curtain or a wall.
    """
    hair = cv2.erode((share > _HAIR).numpy().astype(np.uint8), np.ones((3, 3), np.uint8))
    _, label = cv2.connectedComponents(hair, connectivity=4)
    brows = shown.in_crop(points[17:27])
    high = int(brows[:, 1].nan_to_num(0.0).amin().clamp(0, len(label)))
    left, right = brows[:, 0].nan_to_num(0.0).aminmax()
    over = label[:high, max(0, int(left)) : max(1, int(right))]
    names, counts = np.unique(over, return_counts=True)
    on_head = [name for name, count in zip(names, counts, strict=True) if name and count > _TUFT]
    return torch.from_numpy(cv2.dilate(np.isin(label, on_head).astype(np.uint8), np.ones((3, 3), np.uint8)))


def _line(heights: Tensor, hair: Tensor, usual: Tensor) -> Tensor:
    """The height () above which most is hair and below which most is skin; the usual one where little is seen."""
    if len(heights) < _FEW:
        return usual
    order = heights.argsort()
    wrong = hair[order].double().cumsum(0) + (~hair[order]).double().flip(0).cumsum(0).flip(0)
    best = int(wrong.argmin())
    # All skin: hair begins above what is seen; all hair: at the lowest.
    if best == len(order) - 1 and not bool(hair[order[-1]]):
        return torch.maximum(usual, heights[order[-1]] + _EDGE)
    line = heights[order[best]]
    # The ends of a fringe hang thinner than half, down to the brows.
    return line - _FRINGE if float(line) < float(usual) - 2 * _FRINGE else line
