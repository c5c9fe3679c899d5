"""Hair as a cap of its colour in the photographs: paint on the head, no geometry."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.landmarks.images.face_crop import cut_crop
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.modeling.photographs.skin_mask import FacePlaces
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
_LEAST, _SHARE = 20, 0.3
_DARKEST, _BLACK = 0.005, 0.07  # the share of a head's pixels that is black, and its usual value in photographs
_BEYOND, _MIDDLE = 0.2, 0.35  # share of hair in a picture above the brows, there about the face's middle
# Of full white; shares: of hair in wide patches (leaves 0.53, hair at least 0.70), of what is green beside them.
_GREEN, _PATCHY, _LEAFY = 0.008, 0.62, 0.2
_COLUMNS, _COLUMN, _FEW = 17, 0.05, 6  # across the forehead, half the width of each, vertices
_STRANDS, _STRAND = 150.0, 0.10
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

    def share(self, place: Tensor) -> Tensor:
        """How much hair covers points (Q,) at places (Q,3)."""
        y, behind = place[:, 1], self.places.ears - place[:, 2]
        column = (place[:, 0] / _TEMPLE).clamp(-1, 1) * ((_COLUMNS - 1) // 2) + (_COLUMNS - 1) // 2
        left = column.floor().long().clamp(max=_COLUMNS - 2)
        line = torch.lerp(self.line[left], self.line[left + 1], column - left)
        line = torch.lerp(line, torch.full_like(line, _SIDEBURN), _ramp(behind, *_SIDES))
        line = torch.lerp(line, torch.full_like(line, _OVER_EARS), _ramp(behind, *_EAR))
        where, low = (_LONG_BEHIND, _LONG_NAPE) if self.long else (_BEHIND, _NAPE)
        line = torch.lerp(line, torch.full_like(line, low), _ramp(behind, *where))
        # Single strands reach farther; locks of a few make the edge uneven.
        wave = 0.01 * (torch.sin(23 * place[:, 0]) + torch.sin(37 * place[:, 0] + 1.3)) + 0.3 * _EDGE * self._strands(
            place
        )
        return _ramp(y - line + wave, -_EDGE, _EDGE)

    def painted(self, colors: Tensor, place: Tensor, share: Tensor) -> Tensor:
        """Colours (Q,3) with the hair over them, in strands that hang down."""
        hair = self.color.to(colors) * (1 + _STRAND / 2 * self._strands(place)[:, None]).to(colors)
        return torch.lerp(colors, hair.clamp(0, 1), share[:, None].to(colors))

    def _strands(self, place: Tensor) -> Tensor:
        """Light and dark of single strands at places (Q,3), (Q,) in [-2,2]."""
        around = torch.atan2(place[:, 0], place[:, 2] - self.places.ears)
        return torch.sin(_STRANDS * around + 3 * torch.sin(7 * place[:, 1])) + torch.sin(2.3 * _STRANDS * around)


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
    place, covered, colors = _over_brows(shown, places, hair)
    high = place[:, 1] > _HAIRLINE - _FALL
    if int((covered & high).sum()) >= max(_LEAST, _SHARE * int(high.sum())):
        color: Tensor | None = colors[covered & high].median(0).values.float()
    else:
        color = _hair_beyond(images, parts, marks)
    if color is None:
        return None
    return HairCap(color, _hairline(place, covered), places[0], hangs_down(parts, torch.stack(list(marks))))


def _over_brows(shown: Sequence[Shown], places: Sequence[FacePlaces], hair: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Places (Q,2), whether there is hair (Q,), and colours (Q,3) of what photographs show above the brows."""
    at, found, colors = list[Tensor](), list[Tensor](), list[Tensor]()
    for one, where, share in zip(shown, places, hair, strict=True):
        seen = (one.cosine > _SQUARE) & (where.place[:, 1] > where.brows + _ABOVE_BROWS) & (where.behind < _SIDES[0])
        at.append(where.place[seen, :2])
        found.append(share[seen] > _HAIR)
        colors.append(one.colors[seen].double())
    return torch.cat(at), torch.cat(found), torch.cat(colors)


def _hairline(place: Tensor, covered: Tensor) -> Tensor:
    """Where hair begins in each column of the forehead, (17,): the height that best parts skin below from hair above,
    so that a fringe is hair and no second pair of brows."""
    across, usual = _usual_line()
    line = torch.stack([
        _line(place[near, 1], covered[near], height)
        for height, near in zip(usual, (place[:, :1] - across).abs().T < _COLUMN, strict=True)
    ])  # fmt: skip
    around = lambda values: torch.cat([values[:1].expand(2), values, values[-1:].expand(2)]).unfold(0, 5, 1)  # noqa: E731
    return around(around(line).median(1).values).mean(1)


def _hair_beyond(images: Sequence[Tensor], parts: Sequence[FaceParts], marks: Sequence[Tensor]) -> Tensor | None:
    """The colour (3,) of hair above the brows and off the head that was found, such as a shock of it; None without."""
    colors = []
    for image, shown, points in zip(images, parts, marks, strict=True):
        size, transform = shown.shares.shape[-1], shown.transform
        crop = cut_crop((255 * image[:3].clamp(0, 1)).byte(), transform, size).float() / 255
        at = points.double() @ transform[:, :2].T + transform[:, 2]
        top = int(at[17:27, 1].amin().clamp(0, size))
        hair = shown.of("hair")[:top] > _HAIR
        middle = (torch.arange(size) - at[36:48, 0].mean()).abs() / (at[45] - at[36]).norm() < _MIDDLE
        share = hair[:, middle].double().mean() if hair.numel() else torch.zeros(())
        if float(share) > _BEYOND and not _leaves(
            crop[:, :top, middle], hair[:, middle], shown.of("skin")[:top, middle]
        ):
            colors.append(crop[:, :top][:, hair])
    return torch.cat(colors, 1).median(1).values if colors else None


def _leaves(crop: Tensor, hair: Tensor, skin: Tensor) -> bool:
    """Whether what is taken for hair (H,W) are leaves behind a bald head: patches beside green ones."""
    whole = cv2.morphologyEx(hair.numpy().astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    green = (crop[1] > crop[[0, 2]].amax(0) + _GREEN)[skin < _HAIR]
    return float(whole.sum()) < _PATCHY * float(hair.sum()) and float(green.double().mean()) > _LEAFY


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
        grown = replace(shown, shares=shown.shares * _grown(shown, points))
        left, right = (
            grown.at(mouth + side * sides[:, None, None] * unit + below[:, None] * down, "hair").nanmean().nan_to_num(0)
            for side in (-1, 1)
        )
        jaw = torch.stack([points[:3].nanmean(0), points[14:17].nanmean(0)])
        widths = ((points[30] - jaw) @ across).abs().nan_to_num(0.0)
        turned = [bool(widths[k] < _FAR * widths[1 - k]) for k in (0, 1)]
        found.append(right if turned[0] else left if turned[1] else torch.maximum(left, right))
    return float(torch.stack(found).median()) > _LONG


def _grown(shown: FaceParts, points: Tensor) -> Tensor:
    """Which pixels (S,S) of a crop belong to hair that is one with hair over the brows' middle, landmarks (68,2).

    What reaches over them beside the head alone is a curtain or a wall.
    """
    hair = cv2.erode((shown.of("hair") > _HAIR).numpy().astype(np.uint8), np.ones((3, 3), np.uint8))
    _, label = cv2.connectedComponents(hair, connectivity=4)
    brows = points[17:27] @ shown.transform[:, :2].T + shown.transform[:, 2]
    high = int(brows[:, 1].nan_to_num(0.0).amin().clamp(0, len(label)))
    left, right = brows[:, 0].nan_to_num(0.0).aminmax()
    over = label[:high, max(0, int(left)) : max(1, int(right))]
    names, counts = np.unique(over, return_counts=True)
    on_head = [name for name, count in zip(names, counts, strict=True) if name and count > _TUFT]
    return torch.from_numpy(cv2.dilate(np.isin(label, on_head).astype(np.uint8), np.ones((3, 3), np.uint8)))


def without_veil(color: Tensor, skin: Tensor, images: Sequence[Tensor], heads: Sequence[Tensor]) -> Tensor:
    """Hair's colour (3,), as dark beside skin's (3,) as in pictures that have black; films of webcams are washed
    out."""
    darkest = []
    for image, head in zip(images, heads, strict=True):
        size = torch.tensor(image.shape[:0:-1], dtype=head.dtype)
        (left, top), (right, bottom) = (head.amin(0).floor().clamp(min=0).minimum(size - 3).long().tolist(),
            head.amax(0).ceil().minimum(size).clamp(min=3).long().tolist())  # fmt: skip
        shown = image[:3, top : max(bottom, top + 3), left : max(right, left + 3)]
        smooth = torch.nn.functional.avg_pool2d(shown[None], 3, 1).mean(1).flatten()
        darkest.append(smooth.kthvalue(1 + int(_DARKEST * (len(smooth) - 1))).values)
    bright, dark = float(skin.mean()), float(color.mean())
    veil = min(float(torch.stack(darkest).mean()) - _BLACK, 0.7 * dark)
    if veil <= 0 or dark >= bright:
        return color
    return color * max(0.2, (bright - (bright - dark) * bright / (bright - veil)) / dark)


def _usual_line() -> tuple[Tensor, Tensor]:
    """Places across the forehead and how high hair usually begins there, (17,) each."""
    across = torch.linspace(-1, 1, _COLUMNS, dtype=torch.float64) * _TEMPLE
    return across, _HAIRLINE - _FALL * (across / _TEMPLE).square()


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


def _ramp(value: Tensor, low: float, high: float) -> Tensor:
    share = ((value - low) / (high - low)).clamp(0, 1)
    return share * share * (3 - 2 * share)
