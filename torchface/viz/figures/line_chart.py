"""Line charts by OpenCV and Pillow, in a twentieth of the time that matplotlib takes with its loading."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont
from torch import Tensor

from torchface.escaped_text import visible
from torchface.rendering.compositing import from_pillow

Array: TypeAlias = "np.ndarray"

_PARTS = 4  # binary digits of a pixel that lines' places have
_APART = 60  # least pixels from a number to the next along an axis; half of it upright
_INK, _GREY = "black", "grey"


class LineChart:
    """A white picture that panels of lines and texts are drawn into."""

    def __init__(self, width: int, height: int) -> None:
        self.pixels: Array = np.full((height, width, 3), 255, np.uint8)
        self._texts: list[tuple[tuple[float, float], str, str, int, bool]] = []

    def panel(self, box: tuple[int, int, int, int], x: tuple[float, float], y: tuple[float, float]) -> "Panel":
        """A panel whose first and last columns and rows are in ``box``, for numbers from the first to the second."""
        cv2.rectangle(self.pixels, box[:2], box[2:], ImageColor.getrgb(_INK))
        return Panel(self, *box, x, y)

    def text(self, place: tuple[float, float], text: str, anchor: str = "mm", size: int = 13, up: bool = False) -> None:
        """A text at a place, by Pillow's anchor; ``up`` reads from below and is centred."""
        self._texts.append((place, visible(text), anchor, size, up))

    def picture(self) -> Tensor:
        """All of it, (3,H,W) in [0,1]."""
        image = Image.fromarray(self.pixels)
        draw = ImageDraw.Draw(image)
        for (x, y), text, anchor, size, up in self._texts:
            font = ImageFont.load_default(size)
            if not up:
                draw.text((x, y), text, fill=_INK, font=font, anchor=anchor)
                continue
            wide, high = (math.ceil(side) for side in draw.textbbox((0, 0), text, font=font)[2:])
            line = Image.new("L", (wide + 2, high + 4))
            ImageDraw.Draw(line).text((1, 1), text, fill=255, font=font)
            turned = line.transpose(Image.Transpose.ROTATE_90)
            image.paste(_INK, (round(x - turned.width / 2), round(y - turned.height / 2)), turned)
        return from_pillow(image)


@dataclass(frozen=True, eq=False)
class Panel:
    """A part of a chart with axes of its own."""

    chart: LineChart
    left: int
    top: int
    right: int
    bottom: int
    x: tuple[float, float]
    y: tuple[float, float]

    def _places(self, x: Array, y: Array) -> Array:
        """Pixels (P,2) within the panel."""
        across = (x - self.x[0]) / ((self.x[1] - self.x[0]) or 1.0) * (self.right - self.left)
        return np.stack([across, (self.y[1] - y) / ((self.y[1] - self.y[0]) or 1.0) * (self.bottom - self.top)], -1)

    def line(self, x: Tensor, y: Tensor, color: str, width: int = 1) -> None:
        """A line through points (P,), with gaps where y is no number."""
        places = self._places(x.double().numpy(), y.detach().double().cpu().numpy())
        known = np.isfinite(places).all(1)
        starts = np.flatnonzero(np.diff(known, prepend=False).astype(bool) & known)
        ends = np.flatnonzero(np.diff(known, append=False).astype(bool) & known) + 1
        whole = np.clip(np.nan_to_num(places), -1e4, 1e5)
        runs = [np.rint(whole[a:b] * 2**_PARTS).astype(np.int32) for a, b in zip(starts, ends, strict=True)]
        inside = self.chart.pixels[self.top : self.bottom + 1, self.left : self.right + 1]
        cv2.polylines(inside, runs, False, ImageColor.getrgb(color), width, cv2.LINE_AA, _PARTS)

    def level(self, y: float, dashed: bool = False) -> None:
        """A grey line at a height, if that is in the panel."""
        place = self._places(np.zeros(1), np.array([y]))[0, 1]
        if math.isfinite(place) and 0 <= place <= self.bottom - self.top:
            row = self.chart.pixels[self.top + round(place), self.left : self.right + 1]
            row[(np.arange(len(row)) % 8 < 5) if dashed else slice(None)] = ImageColor.getrgb(_GREY)

    def numbers(self, across: str | None = None, upright: str | None = None) -> None:
        """Numbers along the axes that have a label."""
        if across is not None:
            for number, text in round_numbers(*self.x, (self.right - self.left) // _APART):
                column = self.left + float(self._places(np.array([number]), np.zeros(1))[0, 0])
                cv2.line(self.chart.pixels, (round(column), self.bottom), (round(column), self.bottom + 4), (0, 0, 0))
                self.chart.text((column, self.bottom + 7), text, "mt", 12)
            self.chart.text(((self.left + self.right) / 2, self.bottom + 23), across, "mt")
        if upright is not None:
            for number, text in round_numbers(*self.y, 2 * (self.bottom - self.top) // _APART):
                row = self.top + float(self._places(np.zeros(1), np.array([number]))[0, 1])
                cv2.line(self.chart.pixels, (self.left - 4, round(row)), (self.left, round(row)), (0, 0, 0))
                self.chart.text((self.left - 7, row), text, "rm", 12)
            self.chart.text((self.left - 55, (self.top + self.bottom) / 2), upright, up=True)

    def legend(self, names: Sequence[tuple[str, str]], row: int | None = None) -> None:
        """Names with their colours from the right, in a row of pixels; near the top if absent."""
        y = self.top + 10 if row is None else row
        right = float(self.right - 8)
        for name, color in reversed(names):
            self.chart.text((right, y), name, "rm", 12)
            right -= ImageFont.load_default(12).getlength(name) + 8
            cv2.line(self.chart.pixels, (round(right - 22), y), (round(right), y), ImageColor.getrgb(color), 2)
            right -= 36


def round_numbers(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """At most so many numbers of one, two or five times a power of ten between two, and as they are written."""
    if not high > low:
        return [(low, f"{low:g}")]
    least = (high - low) / max(most, 1)
    power = 10.0 ** math.floor(math.log10(least))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= least * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    return [(step * number, f"{step * number:.{digits}f}") for number in range(first, last + 1)]
