"""Histograms of oriented gradients at every place of an image."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize, pad, unfold

from torchface.errors import ShapeError, ValueRangeError

FAINT = 0.01  # gradients below this, in units of the image a pixel, count as flat
CLIP = 0.4


@dataclass(frozen=True)
class HogLayout:
    """How a window is described."""

    window: int = 32  # side of the square window, pixels
    cell: int = 8  # side of a cell, pixels; the window holds (window/cell)² of them
    bins: int = 9  # orientations, over half a turn (a gradient and its opposite are one)
    stride: int = 4  # a window is described at every stride-th pixel

    def __post_init__(self) -> None:
        if min(self.window, self.cell, self.bins, self.stride) < 1 or self.window % (2 * self.cell):
            raise ValueRangeError(f"HogLayout: found {self}, expected a window of an even number of cells")
        if self.cell % (2 * self.stride):
            raise ValueRangeError(f"HogLayout: found {self}, expected a cell of an even number of strides")

    @property
    def side(self) -> int:
        """Cells along a window's side."""
        return self.window // self.cell

    def positions(self, rows: Tensor) -> Tensor:
        """Pixel coordinate of the centre of a window at a place of the map."""
        return rows * float(self.stride) - 0.5

    def rows(self, positions: Tensor) -> Tensor:
        """The place of the map whose window is centred nearest to a pixel coordinate, int64."""
        return ((positions + 0.5) / self.stride).round().long()


def cell_map(images: Tensor, layout: HogLayout) -> Tensor:
    """Orientation histograms (B,bins,H/stride+1,W/stride+1) of images (B,C,H,W), normalised, of cells at every stride.

    Gradients vote with their magnitude for the two nearest orientations, of all channels the steepest; a cell is
    divided by the root mean square of the cells around, clipped, and its root taken, so that strong edges do not
    hide faint ones.

    Source: Dalal and Triggs 2005.
    """
    if images.ndim != 4:
        raise ShapeError(f"images: found {tuple(images.shape)}, expected (B,C,H,W)")
    padded = pad(images, (1, 1, 1, 1), mode="replicate")
    along_x = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2
    along_y = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2
    steepest = (along_x.square() + along_y.square()).argmax(1, keepdim=True)
    along_x, along_y = along_x.gather(1, steepest)[:, 0], along_y.gather(1, steepest)[:, 0]
    votes = _votes(along_x, along_y, layout.bins)
    cells = avg_pool2d(votes, layout.cell, layout.stride, padding=layout.cell // 2)
    reach = 2 * layout.cell // layout.stride
    around = avg_pool2d(cells.square().sum(1, keepdim=True), reach + 1, 1, reach // 2, count_include_pad=False)
    return (cells / (around + FAINT**2).sqrt()).clamp(max=CLIP).sqrt()


def _votes(along_x: Tensor, along_y: Tensor, bins: int) -> Tensor:
    """Magnitudes (B,bins,H,W), each shared between the two bins next to its orientation."""
    magnitude = (along_x.square() + along_y.square()).sqrt()
    # Over half a turn no quadrant is needed.
    place = torch.atan(along_y / torch.where(along_x == 0, 1e-30, along_x)) * (bins / math.pi)
    place = torch.where(place < 0, place + bins, place)
    distance = (place[:, None] - torch.arange(bins, device=place.device).view(1, -1, 1, 1)).abs()
    return (1 - torch.minimum(distance, bins - distance)).clamp(min=0) * magnitude[:, None]


def windows(cells: Tensor, layout: HogLayout, centres: Tensor) -> Tensor:
    """Descriptors (N,bins,side,side) of windows centred at places (N,2), column and row, of one map (bins,h,w)."""
    step = layout.cell // layout.stride
    offsets = ((torch.arange(layout.side, device=cells.device) - (layout.side - 1) / 2) * step).long()
    rows = (centres[:, 1, None, None] + offsets[:, None]).clamp(0, cells.shape[1] - 1)
    columns = (centres[:, 0, None, None] + offsets[None, :]).clamp(0, cells.shape[2] - 1)
    return cells[:, rows, columns].permute(1, 0, 2, 3)


def unit_windows(cells: Tensor, layout: HogLayout) -> Tensor:
    """The window at every place of maps (B,bins,h,w) as a column of length 1: (B,bins·side²,h·w)."""
    step = layout.cell // layout.stride
    reach = (layout.side - 1) * step // 2
    columns = unfold(pad(cells, (reach,) * 4, mode="replicate"), layout.side, dilation=step)
    return columns / columns.norm(dim=1, keepdim=True).clamp(min=1e-9)


def similarity(columns: Tensor, filters: Tensor) -> Tensor:
    r"""Cosine (B,K,P) of the angle between filters (K,bins,side,side) and windows: a normalised convolution.

    The windows of a map are put side by side once and serve every landmark's filters.
    """
    return normalize(filters.flatten(1), dim=1, eps=1e-9) @ columns
