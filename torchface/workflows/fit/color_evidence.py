"""What colours of hair, brows and lips beside the skin's say of whether photographs show one person."""

import math

import torch
from torch import Tensor

from torchface.color_space import to_linear
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.modeling.photographs.image_texture import GREY

_SKIN, _FEWEST = 0.9, 15  # share, pixels
# Of each: share of pixels that count, which columns of the colours it has, and the scales of Student's t by which these
# differ in photographs of one person and of two: of 14 rendered people, 24 real ones, and other light on each.
_PARTS = {
    "hair": (0.8, slice(0, 1), 0.30, 1.30),
    "brows": (0.6, slice(1, 2), 0.18, 0.40),
    "lips": (0.8, slice(2, 4), 0.10, 0.28),
}
_FREEDOM = 4.0  # degrees, for hair is dyed and lips are painted
_DARKEST = 2e-3  # of full light


def part_colors(image: Tensor, parts: FaceParts) -> Tensor:
    """Logarithms of how bright hair and brows are beside the skin, and of lips' red over green and blue over green
    beside the skin's, (4,) float64; NaN for what a photograph (3,H,W) does not show.

    The brightness of a photograph's light and its hue change none of them.
    """
    crop = parts.crop(image).double()
    linear, result = to_linear(crop).clamp(min=_DARKEST).log(), torch.full((4,), torch.nan, dtype=torch.float64)
    skin = parts.of("skin") > _SKIN
    if int(skin.sum()) < _FEWEST:
        return result
    has_hue = float((crop[:, skin].amax(0) - crop[:, skin].amin(0)).mean()) > GREY
    for name, (share, columns, *_) in _PARTS.items():
        shown = parts.of(name) > share
        if int(shown.sum()) < _FEWEST:
            continue
        apart = linear[:, shown].median(1).values - linear[:, skin].median(1).values
        if name != "lips":
            result[columns] = apart.mean()
        elif has_hue:
            result[columns] = apart[[0, 2]] - apart[1]
    return result


def color_evidence(colors: Tensor) -> Tensor:
    """Logarithms of the odds (I,) that each of I photographs shows the person of the others, by their colours (I,4), in
    the mean over those; 0 where nothing is to be compared."""
    pairs = colors[:, None] - colors
    odds = torch.tensor([
        [sum(_odds(apart[columns], one, two) for _, columns, one, two in _PARTS.values()) for apart in row]
        for row in pairs
    ], dtype=torch.float64)  # fmt: skip
    return odds.fill_diagonal_(0.0).sum(1) / max(1, len(colors) - 1)


def _odds(apart: Tensor, one: float, two: float) -> float:
    """The logarithm of how much likelier a difference (K,) is with the first scale of Student's t than the second."""
    if not bool(apart.isfinite().all()):
        return 0.0
    count, square = len(apart), float(apart.square().sum())
    tail = [math.log1p(square / (scale**2 * _FREEDOM)) for scale in (two, one)]
    return count * math.log(two / one) + (_FREEDOM + count) / 2 * (tail[0] - tail[1])
