"""The line between two lips or two lids, traced through an image by iterated conditional modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.smoothing import gaussian_blur


@dataclass(frozen=True)
class TraceSettings:
    """How a line is traced; lengths in pixels.

    Args:
        border: the line stays this near to the box round the two corners, above and below.
        similar: weight of neighbours having the same intensity.
        dark: weight of being dark.
        smooth: weight of neighbours lying level, a squared pixel.
        near: weight of staying near the arc that the line starts as, a squared share of the line's length.
        blurs: standard deviations of the blur under which the line is found first, and then finer.
        sags: the line starts as an arc that sags by these shares of its length; the best end wins.
        sweeps: at most so many a blur; fewer when nothing moves any more.
        loose_ends: a corner is only known to within so many pixels up or down.
    """

    border: int = 50
    similar: float = 1.0
    dark: float = 1.0
    smooth: float = 0.1
    near: float = 60.0
    blurs: tuple[float, ...] = (2.0,)
    sags: tuple[float, ...] = (-0.08, 0.0, 0.08, 0.16)
    sweeps: int = 15
    loose_ends: int = 8


@dataclass(frozen=True, eq=False)
class Contour:
    """A traced line.

    Args:
        points: one a pixel column from the left corner to the right one, (N,2), x right and y down.
        kept: whether a point is as dark as the line, within one standard deviation, (N,) bool.
        energy: what was minimised, a column.
    """

    points: Tensor
    kept: Tensor
    energy: float

    def resampled(self, count: int) -> Tensor:
        """Points (count,2) evenly spaced along the line, both ends included."""
        return evenly_spaced(self.points, count)


def evenly_spaced(points: Tensor, count: int) -> Tensor:
    """``count`` points at equal arc length along a polyline (N,D), both ends included."""
    steps = (points[1:] - points[:-1]).norm(dim=-1)
    along = torch.cat([steps.new_zeros(1), steps.cumsum(0)])
    wanted = torch.linspace(0, 1, count, dtype=points.dtype, device=points.device) * along[-1]
    after = torch.searchsorted(along, wanted).clamp(1, len(points) - 1)
    share = (wanted - along[after - 1]) / (along[after] - along[after - 1]).clamp(min=1e-12)
    return points[after - 1] + share[:, None] * (points[after] - points[after - 1])


def trace_contour(image: Tensor, left: Tensor, right: Tensor, settings: TraceSettings | None = None) -> Contour:
    r"""Traces the dark line between two corners.

    A line has one row :math:`y_c` a column c; with I the intensity over its standard deviation in the box,

    .. math:: E = \sum_{c=1}^{N} a\,(I_c - I_{c+1})^2 + b\, I_c + s\,(y_c - y_{c+1})^2
        + \tfrac{d}{N^2} (y_c - y^0_c)^2 ,

    with :math:`y^0` the arc that it starts as; the thesis starts from the straight line, which is one of them.

    Iterated conditional modes goes from the left corner to the right one and gives every column the row that is best
    for its two neighbours as they are, again and again until nothing moves. Rows brighter than the present line's
    mean by more than one standard deviation are not considered.

    Args:
        image: grey (1,S,S) or colours (3,S,S) in [0,1].
        left, right: corners, (2,) pixels; the left one further left by two pixels at least.
        settings: weights and limits.

    Raises:
        ShapeError: not an image.
        ValueRangeError: the corners are not finite, outside the image, or not left and right.

    Source: thesis 3.2.2; Besag 1986.
    """
    settings = settings or TraceSettings()
    box, rows, columns = _box(image, left, right, settings.border)
    ends = np.array([float(left[1]) - rows[0], float(right[1]) - rows[0]])
    along = np.linspace(0.0, 1.0, len(columns))
    straight = ends[0] + along * (ends[1] - ends[0])
    arc = 4 * along * (1 - along) * len(columns)
    starts = np.stack([straight + sag * arc for sag in settings.sags])
    path = starts.round().clip(0, len(rows) - 1).astype(np.int64)
    grey = np.zeros(0)
    for blur in settings.blurs:  # each goes on from where the coarser one ended
        grey = gaussian_blur(box[None, None], blur)[0, 0].double().numpy()
        grey = (grey - grey.min()) / max(float(grey.std()), 1e-6)
        path = _sweep(grey, path, starts, settings)
    energies = _energy(grey, path, starts, settings)
    best = int(energies.argmin())
    line = path[best]
    shade = grey[line, np.arange(len(line))]
    kept = shade <= shade.mean() + shade.std()
    points = torch.stack([torch.from_numpy(columns).double(), torch.from_numpy(line + rows[0]).double()], dim=-1)
    return Contour(points, torch.from_numpy(kept), float(energies[best]))


def _box(image: Tensor, left: Tensor, right: Tensor, border: int) -> tuple[Tensor, NDArray, NDArray]:
    """Grey values round the corners, and the image rows and columns they come from."""
    if image.ndim != 3:
        raise ShapeError(f"image: found {tuple(image.shape)}, expected (C,S,S)")
    height, width = image.shape[1:]
    ends = torch.stack([left, right]).double()
    if (
        not torch.isfinite(ends).all()
        or ends.min() < 0
        or ends[:, 0].max() > width - 1
        or ends[:, 1].max() > height - 1
    ):
        raise ValueRangeError(f"corners: found {ends.tolist()}, expected pixels of an image of {width} x {height}")
    first, last = int(ends[0, 0].round()), int(ends[1, 0].round())
    if last - first < 2:
        raise ValueRangeError(f"corners: found columns {first} and {last}, expected the left one left of the right one")
    top = max(0, int(ends[:, 1].min()) - border)
    bottom = min(height - 1, int(ends[:, 1].max()) + border)
    box = image[:, top : bottom + 1, first : last + 1].mean(0).float()
    return box, np.arange(top, bottom + 1), np.arange(first, last + 1)


def _sweep(grey: NDArray, path: NDArray, starts: NDArray, settings: TraceSettings) -> NDArray:
    """Passes over the columns of S lines (S,N) at once, from left to right, until nothing moves."""
    path = path.copy()
    lines = np.arange(len(path))
    count = path.shape[1]
    row = np.arange(len(grey), dtype=np.float64)
    outside = np.abs(row[:, None] - starts[0, [0, -1]]) > settings.loose_ends
    pull = settings.near / count**2
    # The order is the method: a column's choice is what the next column starts from. Hence a loop, and NumPy, whose
    # small operations take a fifth of torch's time.
    for _ in range(settings.sweeps):
        before = path.copy()
        shades = grey[path, np.arange(count)]
        limit = shades.mean(1) + shades.std(1)
        for c in range(count):
            here = grey[:, c]
            cost = settings.dark * here + pull * (row - starts[:, c, None]) ** 2
            for n in (c - 1, c + 1):
                if 0 <= n < count:
                    there = grey[path[:, n], n]
                    cost += settings.similar * (here - there[:, None]) ** 2
                    cost += settings.smooth * (row - path[:, n, None]) ** 2
            cost[here > limit[:, None]] += 1e6
            if c in (0, count - 1):
                cost[:, outside[:, 0 if c == 0 else 1]] += 1e9
            path[lines, c] = cost.argmin(1)
        if (path == before).all():
            break
    return path


def _energy(grey: NDArray, path: NDArray, starts: NDArray, settings: TraceSettings) -> NDArray:
    """Mean energy a column of lines (S,N)."""
    shades = grey[path, np.arange(path.shape[1])]
    total = settings.dark * shades.sum(1) + settings.similar * (np.diff(shades, axis=1) ** 2).sum(1)
    total = total + settings.near / path.shape[1] ** 2 * ((path - starts) ** 2).sum(1)
    return (total + settings.smooth * (np.diff(path, axis=1) ** 2).sum(1)) / path.shape[1]
