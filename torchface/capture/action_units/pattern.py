"""Segmentation of the painted pattern from the skin by brightness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ValueRangeError

_BINS = 128
_MIN_CONTRAST = 0.15
_FRACTIONS = (0.01, 0.45)
_MAX_PAINT = 0.35  # of a region; what is brighter than Otsu's threshold and covers more is skin beside hair or eyes
_FROM, _TO = 0.4, 0.9  # between skin, 0, and paint, 1: where the soft threshold begins and ends


@dataclass(frozen=True, eq=False)
class PatternLevels:
    """Mean grey of skin and of paint in each region, (R,) each."""

    skin: Tensor
    paint: Tensor

    def pattern(self, images: Tensor) -> Tensor:
        """The fraction of a pixel that is paint, (...,R,h,w) in [0,1].

        A soft threshold between skin and paint, nearer to the paint because of highlights on the skin; partly covered
        pixels count in part, so that motion of less than a pixel is kept.
        """
        skin, paint = self.skin[:, None, None], self.paint[:, None, None]
        fraction = (images - skin) / (paint - skin)
        return ((fraction - _FROM) / (_TO - _FROM)).clamp(0, 1)


def pattern_levels(neutral: Tensor, names: Sequence[str]) -> PatternLevels:
    """The greys of skin and paint, by Otsu's threshold in each region, taken again where it found skin.

    Args:
        neutral: regions of an image of the face at rest, (R,h,w) in [0,1].
        names: of the regions.

    Raises:
        ValueRangeError: a region shows no pattern: too little contrast, or too much or too little of it.

    Source: Otsu 1979; thesis 4.1.9.
    """
    skin, paint = [], []
    for name, region in zip(names, neutral, strict=True):
        values = region.flatten()
        threshold = otsu_threshold(values)
        if float((values > threshold).float().mean()) > _MAX_PAINT:
            threshold = otsu_threshold(values[values > threshold])
        bright, dark = values[values > threshold], values[values <= threshold]
        share = len(bright) / len(values)
        contrast = float(bright.mean() - dark.mean()) if len(bright) and len(dark) else 0.0
        if contrast < _MIN_CONTRAST or not _FRACTIONS[0] <= share <= _FRACTIONS[1]:
            raise ValueRangeError(
                f"region {name!r} shows no painted pattern: {share:.0%} of it is brighter than the rest by "
                f"{contrast:.2f}, expected {_FRACTIONS[0]:.0%} to {_FRACTIONS[1]:.0%} brighter by "
                f"{_MIN_CONTRAST} at least"
            )
        skin.append(dark.median())
        paint.append(bright.median())
    return PatternLevels(torch.stack(skin), torch.stack(paint))


def otsu_threshold(values: Tensor) -> float:
    r"""The threshold that leaves the most variance between the two classes.

    .. math:: \max_t \; p_0 p_1 (\mu_0 - \mu_1)^2

    Args:
        values: (N,).
    """
    low, high = float(values.min()), float(values.max())
    if high <= low:
        return high
    counts = torch.histc(values.float(), _BINS, low, high).double()
    middle = low + (high - low) * (torch.arange(_BINS, dtype=torch.float64) + 0.5) / _BINS
    below = counts.cumsum(0)
    above = below[-1] - below
    mean_below = (counts * middle).cumsum(0) / below.clamp(min=1)
    mean_above = ((counts * middle).sum() - (counts * middle).cumsum(0)) / above.clamp(min=1)
    between = below * above * (mean_below - mean_above) ** 2
    # A gap between the classes leaves many thresholds equally good: its middle.
    best = (between >= between.max() * (1 - 1e-9)).nonzero()[:, 0].double().mean()
    return low + (high - low) * (float(best) + 1) / _BINS
