"""From a head-camera video to stabilised images of its painted regions."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.action_units.painted_pattern import aligned_grid, neutral_flow, pattern_levels
from torchface.capture.action_units.painted_regions import region_grid, sample_regions
from torchface.capture.action_units.stabilization import PointTracker, steady_transforms
from torchface.errors import AlignmentError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io.action_labels import ActionLabels
from torchface.io.video import VideoFile, open_video
from torchface.progress import Progress, silent

SIZE = 48
_CHUNK = 64
_STILL = torch.eye(2, 3)[None]


@dataclass(frozen=True, eq=False)
class RegionVideo:
    """The painted regions of a video, stabilised.

    Args:
        names: of the regions, R.
        patterns: (T,R,h,w) in [0,1], the fraction of a pixel that is paint.
        neutral: the regions at rest, (R,h,w), unwarped: the reference of other videos.
        rest: the regions at rest, (R,h,w), warped to another performer's as all frames are.
        fps: frames a second.

    Example:
        >>> stroke = torch.zeros(10, 1, 24, 24)
        >>> video = RegionVideo(("brow_left",), stroke, stroke[0], stroke[0], fps=60.0)
        >>> video.patterns[0].shape == video.neutral.shape
        True
    """

    names: tuple[str, ...]
    patterns: Tensor
    neutral: Tensor
    rest: Tensor
    fps: float

    def chunks(self) -> Iterator[Tensor]:
        """The patterns, some frames at a time."""
        return iter(self.patterns.split(_CHUNK))


@dataclass(frozen=True, eq=False)
class RegionFilm:
    """The painted regions of a video's file, read when they are wanted; fields as of :class:`RegionVideo`."""

    names: tuple[str, ...]
    neutral: Tensor
    rest: Tensor
    fps: float
    chunks: Callable[[], Iterator[Tensor]]


def read_regions(
    video: VideoFile | str | Path,
    labels: ActionLabels,
    names: Sequence[str],
    reference: Tensor | None = None,
    size: int = SIZE,
    progress: Progress | None = None,
) -> RegionVideo:
    """Stabilises a video, cuts its regions out, thresholds the pattern and warps it to a reference's.

    Args:
        video: the file.
        labels: where helmet, markers and regions are.
        names: which regions, R, in which order.
        reference: another performer's neutral patterns (R,h,w), to which these are warped; none if absent.
        size: pixels a side of a region.
        progress: called with each step and how far it is.

    Raises:
        FileFormatError: the video cannot be decoded.
        ShapeError: video and labels differ in length.
        ValueRangeError: a region reaches out of the image, or shows no pattern.
        AlignmentError: helmet or markers cannot be followed.
        NameMismatchError: a region has no box.
    """
    film = open_regions(video, labels, names, reference, size, progress)
    return RegionVideo(film.names, torch.cat(list(film.chunks())), film.neutral, film.rest, film.fps)


def open_regions(
    video: VideoFile | str | Path,
    labels: ActionLabels,
    names: Sequence[str],
    reference: Tensor | None = None,
    size: int = SIZE,
    progress: Progress | None = None,
) -> RegionFilm:
    """What :func:`read_regions` reads, with a few frames in memory at a time."""
    video = video if isinstance(video, VideoFile) else open_video(video)
    _check_length(video, labels, video.count)
    still = video.frame(labels.neutral)
    grey = still[None].float() / 255
    try:
        grid = region_grid(labels.regions, names, size, video.width, video.height)
        levels = pattern_levels(sample_regions(grey, grid, _STILL)[0], names)
        neutral = levels.pattern(sample_regions(grey, grid, _STILL)[0])
        if reference is not None:
            grid = aligned_grid(grid, neutral_flow(neutral, reference))
        tracker = PointTracker(still, torch.tensor(labels.helmet), torch.tensor(labels.markers))
        tracked = [tracker(chunk) for chunk in video.chunks(_CHUNK)]
        transforms = steady_transforms(tracker.points, torch.cat(tracked))
    except (AlignmentError, NameMismatchError, ValueRangeError) as error:
        raise type(error)(f"{labels.source}: {error} ({video.path.name})") from None
    _check_length(video, labels, len(transforms))
    if levels.dark:
        warnings.warn(f"{video.path.name}: the paint is taken to be darker than the skin", stacklevel=2)
    rest = levels.pattern(sample_regions(grey, grid, transforms[labels.neutral, None]))[0]

    def chunks() -> Iterator[Tensor]:
        done = 0
        for chunk in islice(video.chunks(_CHUNK), len(tracked)):
            yield levels.pattern(sample_regions(chunk.float() / 255, grid, transforms[done : done + len(chunk)]))
            done += len(chunk)
            (progress or silent)(f"reading regions of {video.path.name}", done, labels.frames)

    return RegionFilm(tuple(names), neutral, rest, video.fps, chunks)


def _check_length(video: VideoFile, labels: ActionLabels, found: int) -> None:
    if found != labels.frames:
        raise ShapeError(
            f"{video.path}: found {found} frames, expected {labels.frames} as its labels say; they belong to another "
            "video or another cut"
        )
