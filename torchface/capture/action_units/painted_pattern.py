"""The painted pattern: segmented from the skin by its grey, and warped to another performer's.

A dense flow between two performers' neutral images serves for every frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.rendering.gaussian_blur import gaussian_blur

_MIN_CONTRAST = 0.15
_FRACTIONS = (0.01, 0.45)
_MAX_PAINT = 0.35  # of a region; what is brighter than Otsu's threshold and covers more is skin beside hair or eyes
_WORDS = {1.0: "is brighter", -1.0: "is darker"}
_SOFTENING = 1.0  # pixels, standard deviation
_FROM, _TO = 0.4, 0.9  # between skin, 0, and paint, 1: where the soft threshold begins and ends


@dataclass(frozen=True, eq=False)
class PatternLevels:
    """Mean grey of skin and of paint in each region, (R,) each."""

    skin: Tensor
    paint: Tensor

    @property
    def dark(self) -> bool:
        """Whether paint is darker than the skin."""
        return bool((self.paint < self.skin).all())

    def pattern(self, images: Tensor) -> Tensor:
        """The fraction of a pixel that is paint, (...,R,h,w) in [0,1].

        A soft threshold between skin and paint, nearer to the paint because of highlights and shadows on the
        skin; partly covered pixels count in part, so that motion of less than a pixel is kept.
        """
        skin, paint = self.skin[:, None, None], self.paint[:, None, None]
        fraction = (images - skin) / (paint - skin)
        return ((fraction - _FROM) / (_TO - _FROM)).clamp(0, 1)


def pattern_levels(neutral: Tensor, names: Sequence[str]) -> PatternLevels:
    """The greys of skin and paint at rest, (R,h,w), by Otsu's threshold in each region, taken again where it found
    skin.

    Paint is brighter than the skin in all regions, or darker in all: where both could be, what covers less with more
    contrast, as strokes do, and not lit skin beside them, nor brows.

    Source: Otsu 1979; thesis 4.1.9, whose paint is white.
    """
    found = dict[float, PatternLevels]()
    faults = []
    for sign in (1.0, -1.0):
        skin, paint, contrast, share = torch.tensor([_region_levels(sign * region.flatten()) for region in neutral]).T
        wrong = (contrast < _MIN_CONTRAST) | (share < _FRACTIONS[0]) | (share > _FRACTIONS[1])
        if wrong.any():
            first = int(wrong.nonzero()[0, 0])
            faults.append(f"{share[first]:.0%} of region {names[first]!r} {_WORDS[sign]} by {contrast[first]:.2f}")
        else:
            found[float((contrast / share).median())] = PatternLevels(sign * skin, sign * paint)
    if not found:
        raise ValueRangeError(
            f"found no painted pattern, brighter than the skin or darker: {faults[0]}, {faults[1]} than the rest; "
            f"expected {_FRACTIONS[0]:.0%} to {_FRACTIONS[1]:.0%} of every region, by {_MIN_CONTRAST} at least"
        )
    return found[max(found)]


def _region_levels(values: Tensor) -> tuple[float, float, float, float]:
    """Of a region's pixels (N,) the greys of skin and of paint, which is brighter, by how much, and its share."""
    threshold = otsu_threshold(values)
    if float((values > threshold).float().mean()) > _MAX_PAINT:
        threshold = otsu_threshold(values[values > threshold])
    bright, dark = values[values > threshold], values[values <= threshold]
    if not len(bright) or not len(dark):
        return 0.0, 0.0, 0.0, 0.0
    contrast = float(bright.mean() - dark.mean())
    return float(dark.median()), float(bright.median()), contrast, len(bright) / len(values)


def otsu_threshold(values: Tensor) -> float:
    """The threshold of values (N,) with the largest variance between the two classes, by OpenCV."""
    import cv2

    low, high = float(values.min()), float(values.max())
    if high <= low:
        return high
    grey = (255 * (values - low) / (high - low)).round().byte().numpy()
    level, _ = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    return low + (high - low) * (level + 0.5) / 255


def neutral_flow(own: Tensor, reference: Tensor) -> Tensor:
    r"""The flow (R,h,w,2), pixels, from each pixel of the reference's neutral pattern to the same spot of one's own.

    .. math:: \text{own}(x + u(x)) \approx \text{reference}(x)

    Found once a performer, at rest, and used for every frame: a flow a frame would remove the expression.

    Source: Kroeger et al. 2016; thesis 4.1.12.
    """
    if own.shape != reference.shape or own.ndim != 3:
        raise ShapeError(f"patterns: found {tuple(own.shape)} and {tuple(reference.shape)}, expected (R,h,w) twice")
    flows = [_flow(a, b) for a, b in zip(_grey(reference), _grey(own), strict=True)]
    return torch.stack(flows)


def aligned_grid(grid: Tensor, flow: Tensor) -> Tensor:
    """The sampling grid of the regions moved by a flow in region pixels; both (R,h,w,2)."""
    step = torch.stack([grid[:, 0, 1, 0] - grid[:, 0, 0, 0], grid[:, 1, 0, 1] - grid[:, 0, 0, 1]], dim=-1)
    return grid + flow * step[:, None, None]


def _grey(patterns: Tensor) -> np.ndarray:
    """Softened 8-bit images: what is thresholded has edges that a flow cannot follow."""
    soft = gaussian_blur(patterns[:, None], _SOFTENING)[:, 0]
    return (255 * soft.clamp(0, 1)).round().byte().numpy()


def _flow(start: np.ndarray, end: np.ndarray) -> Tensor:
    import cv2

    solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    solver.setFinestScale(0)
    return torch.from_numpy(solver.calc(start, end, np.zeros((*start.shape, 2), np.float32)))
