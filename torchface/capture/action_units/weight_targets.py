"""A classified video as weight curves of a rig, for the hybrid solve."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.action_units.classifier import ActionUnitClassifier
from torchface.capture.action_units.region_video import RegionFilm, RegionVideo, open_regions
from torchface.capture.action_units.shape_table import ShapeTable
from torchface.errors import NameMismatchError, ShapeError
from torchface.io.action_labels import ActionLabels
from torchface.io.video import VideoFile
from torchface.progress import Progress
from torchface.temporal import interpolated, savitzky_golay

WINDOW = 25  # frames at 60 a second; a blink is over sooner than the others, so its window is the shortest
WINDOWS: dict[str, int] = {"45": 15, "7": 21, "6+43": 21, "18L": 29, "18R": 29}  # Windows of units that have their own

_RATE = 60.0
_MIN_WINDOW = 5
_LEAST_PAINT, _MOST_PAINT = 0.4, 3.0  # beside that at rest; expressions show 0.7 to 1.8 of it


@dataclass(frozen=True, eq=False)
class ActionUnitCurves:
    """A classifier's predictions in a rig's shapes.

    Args:
        names: of the shapes, N.
        weights: predicted, smoothed, (T,N) in [0,1].
        active: the frames in which the prediction is used in the solve, (T,N) bool; see ``action_unit_curves``.
        units: of the classifier, A.
        intensities: smooth, (T,A) in [0,1].
        levels: predicted frame by frame, (T,A).
        fps: frames a second.
        seen: whether the regions of each unit show about as much paint as at rest, (T,A) bool.
    """

    names: tuple[str, ...]
    weights: Tensor
    active: Tensor
    units: tuple[str, ...]
    intensities: Tensor
    levels: Tensor
    fps: float
    seen: Tensor


@dataclass(frozen=True)
class CurveSettings:
    """Which of a classifier's units count in a solve, and how they are smoothed.

    Args:
        units: names of those that count; all if absent.
        windows: frames at 60 a second over which each unit is smoothed.
        at_rest: also use predictions where no unit is active; otherwise only the markers count, as in the source.

    Example:
        >>> CurveSettings(units=("9", "25")).at_rest
        True
    """

    units: Sequence[str] | None = None
    windows: Mapping[str, int] = field(default_factory=lambda: WINDOWS)
    at_rest: bool = True


def action_unit_curves(
    classifier: ActionUnitClassifier,
    video: VideoFile | RegionVideo | str | Path,
    labels: ActionLabels,
    table: ShapeTable,
    names: Sequence[str],
    settings: CurveSettings = CurveSettings(),
    progress: Progress | None = None,
) -> ActionUnitCurves:
    r"""Classifies a video and gives the curves :math:`\tilde w` of a rig's shapes.

    A shape that several units move follows the one that moves it most. The prediction of a shape is used where a
    unit that moves it is active, and where none is: shapes that markers hardly observe fit their noise there. Where
    only a unit is active that is not to be used, or the paint of a unit that moves it is hidden, it is left to the
    markers.

    Args:
        classifier: a trained one.
        video: the file, or its regions where they have been read already.
        labels: where helmet, markers and regions are in it.
        table: units in the rig's shapes.
        names: of the rig's shapes, N.
        settings: which units count, and how they are smoothed.
        progress: called with each step and how far it is.

    Raises:
        NameMismatchError: the rig lacks a shape of the table, or ``settings.units`` names one that the
            classifier does not know.
        FileFormatError, ShapeError, ValueRangeError, AlignmentError: the video cannot be used; see ``read_regions``.

    Source: thesis 4.1.8 and 4.1.12.
    """
    units = settings.units
    unknown = sorted(set(units or ()) - set(classifier.units))
    if unknown:
        raise NameMismatchError(f"units: found {', '.join(unknown)}, expected some of {', '.join(classifier.units)}")
    whole = matrix = table.matrix(classifier.units, names)
    if units is not None:
        matrix = whole * torch.tensor([[float(unit in units)] for unit in classifier.units])
    read = (
        video
        if isinstance(video, RegionVideo)
        else open_regions(video, labels, classifier.regions, classifier.neutral, classifier.size, progress=progress)
    )
    levels, seen = _levels_and_paint(classifier, read)
    # What is before the lens for a while is no expression; the curve goes on over it.
    for unit, shown in enumerate(seen.T):
        levels[:, unit] = interpolated(levels[shown, unit], shown.nonzero()[:, 0], len(levels)) if shown.any() else 0.0
    intensities = smooth_intensities(levels, classifier.units, settings.windows, fps=read.fps)
    weights = (intensities[:, :, None] * matrix).amax(1).clamp(0, 1)
    active = _moved(levels, matrix)
    if settings.at_rest:
        active |= (matrix > 0).any(0) & ~_moved(levels, whole)
    active &= ~_moved(~seen, matrix)
    return ActionUnitCurves(tuple(names), weights, active, classifier.units, intensities, levels, read.fps, seen)


def smooth_intensities(
    intensities: Tensor, units: Sequence[str], windows: Mapping[str, int] = WINDOWS, fps: float = _RATE
) -> Tensor:
    """A classifier's levels (T,A) as continuous curves in [0,1], by Savitzky and Golay's filter with windows of frames
    at 60 a second.

    Source: thesis 4.1.12.
    """
    if intensities.ndim != 2 or intensities.shape[1] != len(units):
        raise ShapeError(f"intensities: found {tuple(intensities.shape)}, expected (T,{len(units)})")
    frames = [max(round(windows.get(unit, WINDOW) * fps / _RATE), _MIN_WINDOW) for unit in units]
    curves = [savitzky_golay(intensities[:, a].double(), window, 2) for a, window in enumerate(frames)]
    return torch.stack(curves, dim=1).clamp(0, 1).float()


def _moved(levels: Tensor, matrix: Tensor) -> Tensor:
    """Shapes that some unit of levels (T,A) moves, by the weights (A,N): (T,N) bool."""
    return (levels > 0).to(matrix) @ (matrix > 0).to(matrix) > 0


def classify(classifier: ActionUnitClassifier, video: RegionVideo) -> Tensor:
    """Levels of intensity (T,A), every frame on its own."""
    return _levels_and_paint(classifier, video)[0]


@torch.no_grad()
def _levels_and_paint(classifier: ActionUnitClassifier, video: RegionVideo | RegionFilm) -> tuple[Tensor, Tensor]:
    """Levels of intensity, and whether the regions of each unit show about as much paint as at rest, (T,A) both."""
    rows = [video.names.index(name) for name in classifier.regions]
    rest, levels, shares = video.rest[rows], [], []
    for chunk in video.chunks():
        levels.append(classifier(chunk[:, rows], rest))
        shares.append(chunk[:, rows].mean((2, 3)) / rest.mean((1, 2)))
    share = torch.cat(shares)
    seen = (share > _LEAST_PAINT) & (share < _MOST_PAINT)
    of_units = [group.regions for group in classifier.groups for _ in group.units]
    shown = torch.tensor([[name in regions for regions in of_units] for name in classifier.regions]).float()
    return torch.cat(levels), ~_moved(~seen, shown)
