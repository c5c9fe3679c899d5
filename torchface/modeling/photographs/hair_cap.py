"""Hair as a cap of its colour in the photographs: paint on the head, no geometry."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.landmarks.images.face_crop import cut_crop
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.modeling.photographs.skin_mask import FacePlaces
from torchface.rendering.camera_visibility import Shown

# In distances between the eyes' outer corners, about the middle between them: how high hair begins over the face's
# middle and how it falls toward the temples; from where to where before the ears' front it comes down to the ear; how
# high over the ears, and how low in the neck.
_HAIRLINE, _FALL, _TEMPLE = 0.76, 0.28, 0.7
_SIDES, _SIDEBURN, _OVER_EARS = (-0.25, -0.02), 0.2, 0.3
_BEHIND, _NAPE = (0.52, 0.64), -0.75
_EDGE, _FRINGE = 0.08, 0.07
_ABOVE_BROWS, _SQUARE, _HAIR = 0.06, 0.3, 0.5
_LEAST, _SHARE = 20, 0.3
_DARKEST, _BLACK = 0.005, 0.07  # the share of a head's pixels that is black, and its usual value in photographs
_BEYOND, _MIDDLE = 0.2, 0.35  # share of hair in a picture above the brows, there about the face's middle
_COLUMNS, _COLUMN, _FEW = 17, 0.05, 6  # across the forehead, half the width of each, vertices
_STRANDS, _STRAND = 150.0, 0.10


@dataclass(frozen=True, eq=False)
class HairCap:
    """Hair that photographs show."""

    color: Tensor  # sRGB, (3,)
    line: Tensor  # how high it begins over the face at places from the right temple to the left, (17,)
    places: FacePlaces

    def share(self, place: Tensor) -> Tensor:
        """How much hair covers points (Q,) at places (Q,3)."""
        y, behind = place[:, 1], self.places.ears - place[:, 2]
        column = (place[:, 0] / _TEMPLE).clamp(-1, 1) * ((_COLUMNS - 1) // 2) + (_COLUMNS - 1) // 2
        left = column.floor().long().clamp(max=_COLUMNS - 2)
        line = torch.lerp(self.line[left], self.line[left + 1], column - left)
        line = torch.lerp(line, torch.full_like(line, _SIDEBURN), _ramp(behind, *_SIDES))
        line = torch.where(behind > _SIDES[1], _OVER_EARS, line)
        line = torch.lerp(line, torch.full_like(line, _NAPE), _ramp(behind, *_BEHIND))
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


def hair_cap(shown: Sequence[Shown], places: Sequence[FacePlaces], hair: Tensor) -> HairCap | None:
    """The hair that photographs show above the brows; None where most of what they show there is skin.

    Where it begins is, in each column of the forehead, the height that best parts skin below from hair above, so that a
    fringe is hair and no second pair of brows.
    """
    at, found, colors = list[Tensor](), list[Tensor](), list[Tensor]()
    for one, where, share in zip(shown, places, hair, strict=True):
        seen = (one.cosine > _SQUARE) & (where.place[:, 1] > where.brows + _ABOVE_BROWS) & (where.behind < _SIDES[0])
        at.append(where.place[seen, :2])
        found.append(share[seen] > _HAIR)
        colors.append(one.colors[seen].double())
    place, covered, color = torch.cat(at), torch.cat(found), torch.cat(colors)
    high = place[:, 1] > _HAIRLINE - _FALL
    if int((covered & high).sum()) < max(_LEAST, _SHARE * int(high.sum())):
        return None
    across, usual = _usual_line()
    line = torch.stack([
        _line(place[near, 1], covered[near], height)
        for height, near in zip(usual, (place[:, :1] - across).abs().T < _COLUMN, strict=True)
    ])  # fmt: skip
    around = lambda values: torch.cat([values[:1].expand(2), values, values[-1:].expand(2)]).unfold(0, 5, 1)  # noqa: E731
    smooth = around(around(line).median(1).values).mean(1)
    return HairCap(color[covered & high].median(0).values.float(), smooth, places[0])


def hair_beyond(
    images: Sequence[Tensor], parts: Sequence[FaceParts], marks: Sequence[Tensor], places: FacePlaces
) -> HairCap | None:
    """Hair that photographs (3,H,W) with landmarks (68,2) show above the brows and off the head found; None without."""
    colors = []
    for image, shown, points in zip(images, parts, marks, strict=True):
        size, transform = shown.shares.shape[-1], shown.transform
        crop = cut_crop((255 * image[:3].clamp(0, 1)).byte(), transform, size).float() / 255
        at = points.double() @ transform[:, :2].T + transform[:, 2]
        top = int(at[17:27, 1].amin().clamp(0, size))
        hair = shown.of("hair")[:top] > _HAIR
        aside = (torch.arange(size) - at[36:48, 0].mean()).abs() / (at[45] - at[36]).norm()
        if hair.numel() and float(hair[:, aside < _MIDDLE].double().mean()) > _BEYOND:
            colors.append(crop[:, :top][:, hair])
    if not colors:
        return None
    return HairCap(torch.cat(colors, 1).median(1).values, _usual_line()[1], places)


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
