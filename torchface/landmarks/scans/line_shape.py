"""Usual course of a line between two corners, and its grey profile: learned from annotated lines."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.rendering.gaussian_blur import gaussian_blur

STATIONS = 17
REACH = 10  # rows above and below a line that its profile spans

_MIN_DEVIATION = 0.02  # of the length: corners are not found more exactly
_BLUR = 1.0


@dataclass(frozen=True, eq=False)
class LineShape:
    """The usual course of a line, in fractions of the length of its chord, and its profile."""

    offset: Tensor  # how far below the chord the line runs at equal steps from its left to its right corner, (K,)
    deviation: Tensor  # standard deviation of that, (K,)
    # Standard deviation of how far above or below their true places corners are found, pixels.
    corner_deviation: float = 0.0
    # Grey values from REACH rows above the line to as many below, at the same steps, with mean 0 and norm 1,
    # (K,2·REACH+1); a line without one is dark.
    profile: Tensor | None = None

    @staticmethod
    def arc(sag: float, deviation: float) -> "LineShape":
        """A parabola that sags by a share of its length; 0 is the straight line."""
        along = torch.linspace(0, 1, STATIONS, dtype=torch.float64)
        return LineShape(4 * sag * along * (1 - along), torch.full((STATIONS,), deviation, dtype=torch.float64))

    @staticmethod
    def fit(
        lines: Sequence[Tensor], images: Sequence[Tensor] | None = None, corner_deviation: float = 0.0
    ) -> "LineShape":
        """The mean course of pixel lines, two at least, each (N,2) from its left to its right corner; with images
        (C,S,S) the profile too."""
        rows = torch.stack([_offsets(line.double()) for line in lines])
        shape = LineShape(rows.mean(0), rows.std(0).clamp(min=_MIN_DEVIATION), corner_deviation)
        if images is None:
            return shape
        pairs = zip(images, lines, strict=True)
        profiles = torch.stack([_profiles_across(image, line.double()) for image, line in pairs])
        return LineShape(shape.offset, shape.deviation, corner_deviation, unit_profiles(profiles.mean(0)))

    def rows(self, left: Tensor, right: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Where the line is expected between two corners (2,): rows (N,) at columns (N,), and deviations, pixels."""
        left, right = left.double(), right.double()
        share = ((columns.double() - left[0]) / (right[0] - left[0])).clamp(0, 1)
        straight = left[1] + share * (right[1] - left[1])
        length = right[0] - left[0]
        return straight + length * _at(self.offset, share), length * _at(self.deviation, share)

    def profiles(self, left: Tensor, right: Tensor, columns: Tensor) -> Tensor:
        """The expected profiles across the line at columns (N,), (N,2·REACH+1)."""
        if self.profile is None:
            raise ValueRangeError("LineShape: found no profile, expected one learned from images")
        share = ((columns.double() - left[0].double()) / (right[0] - left[0]).double()).clamp(0, 1)
        return unit_profiles(_at(self.profile, share))


def unit_profiles(profiles: Tensor) -> Tensor:
    """Profiles (...,P) with mean 0 and norm 1."""
    centred = profiles - profiles.mean(-1, keepdim=True)
    return torch.nn.functional.normalize(centred, dim=-1, eps=1e-6)


def _offsets(line: Tensor) -> Tensor:
    """Offsets (K,) of a line (N,2) below its chord, in chord widths, at equal steps of x."""
    left, right = line[0], line[-1]
    chord = torch.linspace(0, 1, STATIONS, dtype=torch.float64) * (right[1] - left[1]) + left[1]
    return (_rows_at(line, _station_columns(line)) - chord) / (right[0] - left[0])


def _station_columns(line: Tensor) -> Tensor:
    return line[0, 0] + (line[-1, 0] - line[0, 0]) * torch.linspace(0, 1, STATIONS, dtype=torch.float64)


def _rows_at(line: Tensor, columns: Tensor) -> Tensor:
    """Rows (K,) of a line (N,2) at columns (K,)."""
    order = line[:, 0].argsort()
    x, y = line[order, 0], line[order, 1]
    after = torch.searchsorted(x, columns).clamp(1, len(x) - 1)
    share = ((columns - x[after - 1]) / (x[after] - x[after - 1]).clamp(min=1e-9)).clamp(0, 1)
    return y[after - 1] + share * (y[after] - y[after - 1])


def _profiles_across(image: Tensor, line: Tensor) -> Tensor:
    """Profiles (K,2·REACH+1) of an image (C,S,S) across a line (N,2): the mean of the columns round each station."""
    grey = gaussian_blur(image.mean(0, keepdim=True)[None].float(), _BLUR)[0, 0].double()
    height, width = grey.shape
    columns = torch.arange(int(line[0, 0].round()), int(line[-1, 0].round()) + 1, dtype=torch.float64)
    rows = _rows_at(line, columns)[:, None] + torch.arange(-REACH, REACH + 1)
    place = columns.long().clamp(0, width - 1)[:, None]
    lower = rows.floor().clamp(0, height - 2)
    part = (rows - lower).clamp(0, 1)
    values = unit_profiles((1 - part) * grey[lower.long(), place] + part * grey[lower.long() + 1, place])
    station = _station_columns(line)
    near = (1 - (columns - station[:, None]).abs() / (station[1] - station[0]).clamp(min=1.0)).clamp(min=0)
    return near @ values / near.sum(1, keepdim=True).clamp(min=1e-9)


def _at(values: Tensor, share: Tensor) -> Tensor:
    """Values (K,...) at equal steps of [0,1], interpolated at shares (N,)."""
    values = values.double()
    place = share * (len(values) - 1)
    lower = place.floor().long().clamp(max=len(values) - 2)
    part = (place - lower).view(-1, *(1,) * (values.ndim - 1))
    return values[lower] * (1 - part) + values[lower + 1] * part
