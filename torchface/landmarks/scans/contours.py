"""The line between two lips or two lids, traced through an image by iterated conditional modes."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.scans.line_shape import LineShape, unit_profiles
from torchface.rendering.gaussian_blur import gaussian_blur

_BORDER = 50  # pixels: the line stays this near to the box round the two corners, above and below
_SIMILAR = 1.0  # weight of neighbours having the same intensity, or being as like
_DARK = 2.0  # weight of being dark, or like the learned profile
_SMOOTH = 0.1  # weight of neighbours lying level, a squared pixel
_NEAR = 1.0  # weight of staying near the course that the line begins with, a squared standard deviation
_LINE_WIDTH = 5  # intensity is measured against that so many pixels above and below
_BLUR = 1.0  # pixels
_SAGS = (-0.06, 0.0, 0.06, 0.12)  # shares of its length by which an arc sags where no usual course is known
_DEVIATION = 0.07  # about such an arc, a share of its length
_DISPLACEMENTS = (-2.0, -1.0, 0.0, 1.0, 2.0)  # of uncertain corners, standard deviations; every column pays for them
_ITERATIONS = 15  # at most; fewer when nothing moves any more
_END_TOLERANCE = 8  # pixels up or down to within which a corner is known
_BRIGHT = 4.0  # standard deviations; were such rows forbidden, a column without others would jump to any dark spot


@dataclass(frozen=True, eq=False)
class Contour:
    """A traced line.

    Args:
        points: one a pixel column from the left corner to the right one, (N,2), x right and y down.
        kept: whether a point is as dark as the line, or as like its profile, within one standard deviation, (N,) bool.
        energy: what was minimised, a column.

    Example:
        >>> straight = torch.stack([torch.arange(20.0, 81.0), torch.full((61,), 50.0)], 1)
        >>> Contour(straight, torch.ones(61, dtype=torch.bool), 0.0).resampled(3).tolist()
        [[20.0, 50.0], [50.0, 50.0], [80.0, 50.0]]
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


def trace_contour(image: Tensor, left: Tensor, right: Tensor, shape: LineShape | None = None) -> Contour:
    r"""Traces the line between two corners: a dark one, or one with the profile that was learned.

    A line has one row :math:`y_c` a column c; with I how little a pixel is like the line, over its standard deviation
    in the box,

    .. math:: E = \sum_{c=1}^{N} a\,(I_c - I_{c+1})^2 + b\, I_c + s\,(y_c - y_{c+1})^2
        + d\,(y_c - y^0_c)^2 / \sigma_c^2 ,

    with :math:`y^0` the course that it begins with. In the thesis I is the intensity; here it is how much brighter a
    pixel is than the darker of what lies above and below, or, where its profile was learned from annotated lines,
    1 less the correlation of what lies round the pixel with that profile: the line between two lids need not be the
    darkest of the furrows there. The thesis begins with the straight line and has no last term; here the start is the
    mean of annotated lines where there were any, else the straight line and an arc. Learned lines are tried with
    their ends moved up and down as far as corners usually err; the least energy wins.

    Iterated conditional modes goes from the left corner to the right one and gives every column the row that is best
    for its two neighbours as they are, again and again until nothing moves. Rows brighter than the present line's
    mean by more than one standard deviation cost extra; those that are left at the end are marked, not kept.

    Args:
        image: grey (1,S,S) or colours (3,S,S) in [0,1].
        left, right: corners, (2,) pixels; the left one further left by two pixels at least.
        shape: how the line usually runs, and its profile.

    Raises:
        ShapeError: not an image.
        ValueRangeError: the corners are not finite, outside the image, or not left and right.

    Source: thesis 3.2.2; Besag 1986.

    Example:
        >>> image = torch.ones(1, 100, 100)
        >>> image[0, 50] = 0.0  # a dark line
        >>> line = trace_contour(image, torch.tensor([20.0, 50.0]), torch.tensor([80.0, 50.0]))
        >>> line.points[:, 1].unique().tolist()
        [50.0]
    """
    box, rows, columns = _box(image, left, right)
    shapes = [LineShape.arc(sag, _DEVIATION) for sag in _SAGS] if shape is None else [shape]
    initial, pulls, displaced = _initial_lines(shapes, left, right, torch.from_numpy(columns))
    initial -= rows[0]
    profile = None if shape is None or shape.profile is None else shape.profiles(left, right, torch.from_numpy(columns))
    path = initial.round().clip(0, len(rows) - 1).astype(np.int64)
    smooth = gaussian_blur(box[None, None], _BLUR)[0, 0].double()
    grey = _valleys(smooth.numpy()) if profile is None else _unlike(smooth, profile)
    path = _conditional_modes(grey, path, initial, pulls)
    energies = _energy(grey, path, initial, pulls) + displaced
    best = int(energies.argmin())
    line = path[best]
    shade = grey[line, np.arange(len(line))]
    kept = shade <= shade.mean() + shade.std()
    points = torch.stack([torch.from_numpy(columns).double(), torch.from_numpy(line + rows[0]).double()], dim=-1)
    return Contour(points, torch.from_numpy(kept), float(energies[best]))


def _initial_lines(
    shapes: list[LineShape], left: Tensor, right: Tensor, columns: Tensor
) -> tuple[NDArray, NDArray, NDArray]:
    """Courses (S,N) in image rows, the pulls toward them (S,N), and what the displacement of each costs, (S,).

    Where corners are uncertain, every shape is tried with either end moved up and down.
    """
    share = torch.linspace(0, 1, len(columns), dtype=torch.float64)
    initial, pulls, costs = [], [], []
    for shape in shapes:
        rows, deviation = shape.rows(left, right, columns)
        tried = _DISPLACEMENTS if shape.corner_deviation > 0 else (0.0,)
        for at_left, at_right in product(tried, tried):
            displaced = at_left * (1 - share) + at_right * share
            initial.append(rows + shape.corner_deviation * displaced)
            pulls.append(_NEAR / deviation**2)
            costs.append(_NEAR * float(displaced.square().mean()))
    return torch.stack(initial).numpy(), torch.stack(pulls).numpy(), np.array(costs)


def _box(image: Tensor, left: Tensor, right: Tensor) -> tuple[Tensor, NDArray, NDArray]:
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
    top = max(0, int(ends[:, 1].min()) - _BORDER)
    bottom = min(height - 1, int(ends[:, 1].max()) + _BORDER)
    box = image[:, top : bottom + 1, first : last + 1].mean(0).float()
    return box, np.arange(top, bottom + 1), np.arange(first, last + 1)


def _valleys(grey: NDArray) -> NDArray:
    """How much brighter a pixel is than the darker of those above and below it, in standard deviations: low on dark
    lines, not on dark patches, shadows and their edges."""
    rows = np.arange(len(grey))
    above, below = grey[np.maximum(rows - _LINE_WIDTH, 0)], grey[np.minimum(rows + _LINE_WIDTH, len(grey) - 1)]
    valley = grey - np.minimum(above, below)
    return (valley - valley.min()) / max(float(valley.std()), 1e-6)


def _unlike(grey: Tensor, profile: Tensor) -> NDArray:
    """1 less the correlation of what lies round a pixel with its column's profile (N,P), in standard deviations."""
    reach = profile.shape[1] // 2
    padded = torch.nn.functional.pad(grey[None, None], (0, 0, reach, reach), mode="replicate")[0, 0]
    around = padded.unfold(0, profile.shape[1], 1)
    unlike = 1 - (unit_profiles(around) * profile).sum(-1).numpy()
    return unlike / max(float(unlike.std()), 1e-6)


def _conditional_modes(grey: NDArray, path: NDArray, initial: NDArray, pulls: NDArray) -> NDArray:
    """Passes over the columns of S lines (S,N) at once, from left to right, until nothing moves."""
    path = path.copy()
    lines = np.arange(len(path))
    count = path.shape[1]
    row = np.arange(len(grey), dtype=np.float64)
    outside = np.abs(row[:, None] - initial[:, None, [0, -1]]) > _END_TOLERANCE
    # The order is the method: a column's choice is what the next column begins with. Hence a loop, and NumPy, whose
    # small operations take a fifth of torch's time.
    for _ in range(_ITERATIONS):
        before = path.copy()
        shades = grey[path, np.arange(count)]
        limit = shades.mean(1) + shades.std(1)
        for c in range(count):
            here = grey[:, c]
            cost = _DARK * here + pulls[:, c, None] * (row - initial[:, c, None]) ** 2
            for n in (c - 1, c + 1):
                if 0 <= n < count:
                    there = grey[path[:, n], n]
                    cost += _SIMILAR * (here - there[:, None]) ** 2
                    cost += _SMOOTH * (row - path[:, n, None]) ** 2
            cost[here > limit[:, None]] += _BRIGHT
            if c in (0, count - 1):
                cost[outside[:, :, 0 if c == 0 else 1]] += 1e9
            path[lines, c] = cost.argmin(1)
        if (path == before).all():
            break
    return path


def _energy(grey: NDArray, path: NDArray, initial: NDArray, pulls: NDArray) -> NDArray:
    """Mean energy a column of lines (S,N)."""
    shades = grey[path, np.arange(path.shape[1])]
    total = _DARK * shades.sum(1) + _SIMILAR * (np.diff(shades, axis=1) ** 2).sum(1)
    total = total + (pulls * (path - initial) ** 2).sum(1)
    return (total + _SMOOTH * (np.diff(path, axis=1) ** 2).sum(1)) / path.shape[1]
