"""Errors of found landmarks and lines against the true ones, in pixels and millimetres, and an image of both."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.landmarks import ScanAnnotation, ScanLandmarks
from torchface.landmarks.scans.contours import evenly_spaced
from torchface.landmarks.scans.uv_landmark_names import LINES
from torchface.mesh import Mesh

_FOUND, _TRUE = (1.0, 0.1, 0.1), (0.1, 0.9, 0.2)


@dataclass(frozen=True, eq=False)
class ScanErrors:
    """Errors on one scan."""

    name: str
    pixels: Tensor  # of each landmark, (L,); NaN where the truth is not known
    millimetres: Tensor  # the same in space, (L,)
    lines: dict[str, float]  # by name, mean distance in pixels of the traced points that were kept to the true line

    @property
    def mean_pixels(self) -> float:
        """Over the landmarks."""
        return float(self.pixels.nanmean())


def landmark_errors(found: ScanLandmarks, scan: Mesh, truth: ScanAnnotation, name: str = "") -> ScanErrors:
    """Compares what was found on a scan with the truth about it."""
    known = truth.ordered()
    layout, pose = found.head.layout, found.head.pose
    pixels = (found.pixels.double() - layout.pixels(pose.apply(known[None])[0])).norm(dim=-1)
    millimetres = (found.points.double() - known).norm(dim=-1)
    lines = {}
    for line in LINES:
        if line in truth.lines and line in found.contours:
            path = evenly_spaced(layout.pixels(pose.apply(truth.lines[line][None].double())[0]), 400)
            contour = found.contours[line]
            distance = torch.cdist(contour.points.double(), path).amin(1)
            lines[line] = float(distance[contour.kept].mean())
    return ScanErrors(name, pixels, millimetres, lines)


def error_table(errors: Sequence[ScanErrors]) -> dict[str, float]:
    """Mean, median and worst errors over scans."""
    if not errors:
        return {}
    pixels = torch.stack([error.pixels for error in errors])
    millimetres = torch.stack([error.millimetres for error in errors])
    table = {
        "mean error, pixels": float(pixels.nanmean()),
        "median error, pixels": float(pixels.nanmedian()),
        "worst scan, pixels": max(error.mean_pixels for error in errors),
        "mean error, mm": float(millimetres.nanmean()),
    }
    for line in LINES:
        distance = [error.lines[line] for error in errors if line in error.lines]
        if distance:
            table[f"{line}, pixels"] = sum(distance) / len(distance)
    return table


def draw_result(found: ScanLandmarks, truth: ScanAnnotation | None = None) -> Tensor:
    """The part of the unwrapped image round the face, found landmarks and lines red, true ones green, (3,H,W)."""
    image = found.image.expand(3, -1, -1).clone()
    layout, pose = found.head.layout, found.head.pose
    thick = max(1, found.image.shape[-1] // 512)
    if truth is not None:
        for line in truth.lines.values():
            _dots(image, evenly_spaced(layout.pixels(pose.apply(line[None].double())[0]), 300), thick, _TRUE)
        _dots(image, layout.pixels(pose.apply(truth.ordered()[None])[0]), 3 * thick, _TRUE)
    for contour in found.contours.values():
        _dots(image, contour.points[contour.kept], thick, _FOUND)
    _dots(image, found.pixels, 3 * thick, _FOUND)
    low = found.pixels.amin(0) - 0.09 * layout.size
    high = found.pixels.amax(0) + 0.09 * layout.size
    x0, y0 = (int(v) for v in low.clamp(0, layout.size - 2))
    x1, y1 = (int(v) for v in high.clamp(1, layout.size - 1))
    return image[:, y0:y1, x0:x1]


def _dots(image: Tensor, pixels: Tensor, size: int, color: tuple[float, float, float]) -> None:
    height, width = image.shape[1:]
    pixels = pixels[torch.isfinite(pixels).all(-1)].round().long()
    reach = torch.arange(size) - size // 2
    rows = (pixels[:, 1, None, None] + reach[:, None]).clamp(0, height - 1)
    columns = (pixels[:, 0, None, None] + reach).clamp(0, width - 1)
    image[:, rows, columns] = torch.tensor(color)[:, None, None, None]
