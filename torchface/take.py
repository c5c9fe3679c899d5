"""A performance: markers, landmarks and weights of each frame, by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.number_checks import check_rate

_WIDTHS = {"markers": 3, "landmarks": 2, "weights": 1}


@dataclass(frozen=True, eq=False)
class Track:
    """Named channels over time.

    Args:
        names: one a channel, no name twice (marker labels, shape names, landmark names).
        values: (T,C,D): markers D=3 in millimetres, landmarks D=2 in pixels, weights D=1. NaN means not seen.
        confidence: (T,C) in [0,1], where the source gives one.

    Raises:
        ShapeError: ``values`` is not (T,C,D) with one channel a name.
        NameMismatchError: a name stands twice.

    Example:
        >>> track = Track(("jawOpen", "mouthPucker"), torch.tensor([[[0.1], [0.0]], [[0.5], [0.2]]]))
        >>> track.select(["mouthPucker"]).values.flatten().tolist() == track.values[:, 1, 0].tolist()
        True
    """

    names: tuple[str, ...]
    values: Tensor
    confidence: Tensor | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        if self.values.ndim != 3 or self.values.shape[1] != len(self.names):
            raise ShapeError(f"track: found values {tuple(self.values.shape)}, expected (T,{len(self.names)},D)")
        if self.confidence is not None and self.confidence.shape != self.values.shape[:2]:
            raise ShapeError(
                f"track: found confidence {tuple(self.confidence.shape)}, expected {tuple(self.values.shape[:2])}"
            )
        if len(set(self.names)) != len(self.names):
            twice = sorted({name for name in self.names if self.names.count(name) > 1})
            raise NameMismatchError(f"track: found names more than once: {', '.join(twice[:5])}; expected each once")

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        names = ", ".join(self.names[:3]) + (", ..." if len(self.names) > 3 else "")
        return f"Track({len(self)} frames of {len(self.names)} x {self.values.shape[2]}: {names})"

    def select(self, names: Sequence[str]) -> Track:
        """The channels of these names, in this order."""
        row = {name: i for i, name in enumerate(self.names)}
        missing = [name for name in names if name not in row]
        if missing:
            raise NameMismatchError(
                f"track: no channel {', '.join(map(repr, missing[:5]))}; it has {', '.join(self.names[:5])}, ..."
            )
        ids = torch.tensor([row[name] for name in names], dtype=torch.int64, device=self.values.device)
        return Track(tuple(names), self.values[:, ids], None if self.confidence is None else self.confidence[:, ids])

    def frames(self, rows: slice | Tensor) -> Track:
        """Some of the frames, by rows (T',)."""
        return Track(self.names, self.values[rows], None if self.confidence is None else self.confidence[rows])


@dataclass(frozen=True, eq=False)
class Take:
    """One performance; its tracks have the same number of frames.

    Args:
        fps: frames a second.
        markers: values (T,M,3), millimetres.
        landmarks: values (T,L,2), pixels.
        weights: values (T,N,1), blendshape weights.
        timecode: one text a frame, as the file had it.
        extras: what else the file holds (columns by name, device, subject), kept for writing it back.

    Raises:
        ShapeError: the tracks differ in length, or a track's values are not of its kind's width.
        ValueRangeError: ``fps`` is no rate of a camera, 0.01 to 10,000.

    Example:
        >>> weights = Track(("jawOpen",), torch.linspace(0, 1, 60)[:, None, None])
        >>> take = Take(fps=30.0, weights=weights)
        >>> len(take.frames(slice(0, 15)).weights.values) / take.fps
        0.5
    """

    fps: float
    markers: Track | None = None
    landmarks: Track | None = None
    weights: Track | None = None
    timecode: tuple[str, ...] | None = None
    extras: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_rate(self.fps, "take", ValueRangeError)
        for name, width in _WIDTHS.items():
            track = getattr(self, name)
            if track is not None and track.values.shape[2] != width:
                raise ShapeError(f"take: found {name} {tuple(track.values.shape)}, expected (T,C,{width})")
        if self.timecode is not None:
            object.__setattr__(self, "timecode", tuple(self.timecode))
        lengths = {
            name: len(track)
            for name in ("markers", "landmarks", "weights", "timecode")
            if (track := getattr(self, name)) is not None
        }
        if len(set(lengths.values())) > 1:
            raise ShapeError(f"take: found frame counts {lengths}, expected the same for all")

    def uneven_seconds(self) -> Tensor | None:
        """When each frame is shown, (T,) float64, rising, where ``extras["seconds"]`` says; else frames come evenly.

        Raises:
            ValueRangeError: that is of another length, or does not rise.
        """
        seconds = self.extras.get("seconds")
        if seconds is None:
            return None
        seconds = torch.as_tensor(seconds).detach().cpu().double()
        if seconds.shape != (len(self),) or not bool((seconds.diff() > 0).all()):
            raise ValueRangeError(f"take: found times {tuple(seconds.shape)}, expected ({len(self)},), rising")
        return seconds

    def __len__(self) -> int:
        for track in (self.markers, self.landmarks, self.weights, self.timecode):
            if track is not None:
                return len(track)
        return 0

    def __repr__(self) -> str:
        parts = [f"{len(self)} frames at {self.fps:g} a second"]
        for what in ("markers", "landmarks", "weights"):
            track = getattr(self, what)
            if track is not None:
                parts.append(f"{len(track.names)} {what}")
        if self.timecode:
            parts.append(f"timecode {self.timecode[0]} to {self.timecode[-1]}")
        if self.extras:
            parts.append(f"extras {', '.join(map(str, self.extras))}")
        return f"Take({', '.join(parts)})"

    def frames(self, rows: slice) -> Take:
        """Consecutive frames, with their extras and frame numbers."""
        first, last, step = rows.indices(len(self))
        if step != 1:
            raise ValueRangeError(f"take: found a step of {step} frames, expected consecutive ones")
        rows = slice(first, max(first, last))
        markers, landmarks, weights = (
            None if track is None else track.frames(rows) for track in (self.markers, self.landmarks, self.weights)
        )
        timecode = None if self.timecode is None else self.timecode[rows]
        return Take(self.fps, markers, landmarks, weights, timecode, _cut_extras(self.extras, rows, len(self)))


def _cut_extras(extras: dict[str, Any], rows: slice, count: int) -> dict[str, Any]:
    """What readers keep a frame at a time, cut like the tracks."""
    cut = dict(extras)
    numbers = extras.get("frame_numbers")
    if numbers is not None or rows.start > 0:
        cut["frame_numbers"] = (torch.arange(count) if numbers is None else numbers)[rows]
    if "columns" in extras:
        cut["columns"] = {name: column[rows] for name, column in extras["columns"].items()}
    if "blendshape_count" in extras:
        cut["blendshape_count"] = extras["blendshape_count"][rows]
    if "seconds" in extras:
        cut["seconds"] = extras["seconds"][rows]
    if "gaps" in extras:
        cut["gaps"] = tuple((row - rows.start, lost) for row, lost in extras["gaps"] if rows.start < row < rows.stop)
    return cut


def empty_frames(take: Take) -> Tensor:
    """The frames in which no marker was seen, (K,) int64, rising.

    Example:
        >>> markers = torch.zeros(3, 1, 3)
        >>> markers[1] = torch.nan
        >>> empty_frames(Take(fps=60.0, markers=Track(("chin",), markers))).tolist()
        [1]
    """
    if take.markers is None:
        raise ValueRangeError("take: found no markers, expected some")
    return take.markers.values.isnan().any(2).all(1).nonzero()[:, 0]
