"""A performance: markers, landmarks and weights of each frame, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchface.errors import ArgumentTypeError, NameMismatchError, ShapeError, ValueRangeError
from torchface.number_checks import as_real, as_tensor, check_rate, checked_type
from torchface.temporal.frame_grid import check_gaps, frame_grid
from torchface.temporal.interpolation import frames_beside, values_at

_WIDTHS = {"markers": 3, "landmarks": 2, "weights": 1}


@dataclass(frozen=True, eq=False)
class Track:
    """Named channels over time.

    Args:
        names: one a channel, no name twice (marker labels, shape names, landmark names).
        values: (T,C,D): markers D=3 in millimetres, landmarks D=2 in pixels, weights D=1. NaN means not seen;
            whole numbers become floats.
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
        if isinstance(self.names, str):
            raise ArgumentTypeError(f"names: found the text {self.names!r:.60}, expected a list of names")
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "values", as_real(self.values, "track values"))
        if self.confidence is not None:
            object.__setattr__(self, "confidence", as_real(self.confidence, "track confidence"))
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
        extras: what else the file holds (columns by name, device, subject), kept for writing it back;
            ``frame_numbers`` (T,) where :attr:`numbers` are not 0, 1, ...
        seconds: when each frame is shown, (T,), rising, from any beginning, where frames come unevenly (a camera of
            variable rate, dropped frames); absent where ``fps`` come a second.

    Raises:
        ShapeError: the tracks differ in length, or a track's values are not of its kind's width.
        ValueRangeError: ``fps`` is no rate of a camera, 0.01 to 10,000; or ``seconds`` do not rise.

    Example:
        >>> weights = Track(("jawOpen",), torch.linspace(0, 1, 60)[:, None, None])
        >>> take = Take(fps=30.0, weights=weights)
        >>> take.frames(slice(0, 15)).duration
        0.5
        >>> Take(30.0, weights=weights.frames(slice(0, 3)), seconds=torch.tensor([5.0, 5.5, 6.5])).times.tolist()
        [0.0, 0.5, 1.5]
    """

    fps: float
    markers: Track | None = None
    landmarks: Track | None = None
    weights: Track | None = None
    timecode: tuple[str, ...] | None = None
    extras: dict[str, Any] = field(default_factory=dict)
    seconds: Tensor | None = None

    def __post_init__(self) -> None:
        check_rate(self.fps, "take", ValueRangeError)
        for name, width in _WIDTHS.items():
            track = getattr(self, name)
            if track is not None:
                checked_type(f"take: {name}", track, Track)
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
        if self.seconds is not None:
            seconds = torch.as_tensor(self.seconds).detach().cpu().double()
            if seconds.shape != (len(self),) or not bool(torch.isfinite(seconds).all() & (seconds.diff() > 0).all()):
                raise ValueRangeError(f"take: found times {tuple(seconds.shape)}, expected ({len(self)},), rising")
            object.__setattr__(self, "seconds", seconds)

    @property
    def times(self) -> Tensor:
        """When each frame is shown, seconds after the first one, (T,) float64, even or not."""
        if self.seconds is None:
            return torch.arange(len(self), dtype=torch.float64) / self.fps
        return self.seconds - self.seconds[:1]

    @property
    def numbers(self) -> Tensor:
        """Which frame of the recording each one is, counted from 0, (T,) int64; C3D, TRC and OpenFace count from 1."""
        numbers = self.extras.get("frame_numbers")
        if isinstance(numbers, Tensor) and numbers.shape == (len(self),):
            return numbers
        return torch.arange(len(self))

    @property
    def clock(self) -> Tensor:
        """When each frame is shown by its time or frame number, seconds since the recording began, (T,) float64."""
        if self.seconds is not None:
            return self.seconds
        return self.times + float(self.numbers[:1].sum()) / self.fps

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the end of the last one."""
        return len(self) / self.fps if self.seconds is None else float(self.times[-1:].sum()) + 1 / self.fps

    @property
    def rate(self) -> str:
        """How often frames come, in words."""
        if self.seconds is None:
            return f"{self.fps:g} a second"
        longest = float(self.seconds.diff().max()) if len(self) > 1 else 0.0
        return f"about {self.fps:g} a second at uneven times, up to {longest:.3g} s apart"

    def __len__(self) -> int:
        for track in (self.markers, self.landmarks, self.weights, self.timecode):
            if track is not None:
                return len(track)
        return 0

    def __repr__(self) -> str:
        parts = [f"{len(self)} frames at {self.rate}"]
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
        checked_type("frames", rows, slice)
        first, last, step = rows.indices(len(self))
        if step != 1:
            raise ValueRangeError(f"take: found a step of {step} frames, expected consecutive ones")
        rows = slice(first, max(first, last))
        markers, landmarks, weights = (
            None if track is None else track.frames(rows) for track in (self.markers, self.landmarks, self.weights)
        )
        timecode = None if self.timecode is None else self.timecode[rows]
        extras = _cut_extras(self.extras, rows, len(self))
        seconds = None if self.seconds is None else self.seconds[rows]
        return Take(self.fps, markers, landmarks, weights, timecode, extras, seconds)

    def rows(self, rows: Tensor | Sequence[int]) -> Take:
        """Some frames at their own times, with their extras and frame numbers.

        Args:
            rows: which, rising, (K,) int64, or (T,) bool; negative ones count from the end.

        Raises:
            ValueRangeError: no whole numbers (K,) and no mask (T,), no such frame, or they do not rise.

        Example:
            >>> take = Take(2.0, weights=Track(("jawOpen",), torch.tensor([0.0, 0.5, 1.0])[:, None, None]))
            >>> take.rows(torch.tensor([0, 2])).times.tolist()
            [0.0, 1.0]
        """
        rows = _frame_numbers(as_tensor("rows", rows, "(K,) of whole numbers"), len(self))
        markers, landmarks, weights = (
            None if track is None else track.frames(rows) for track in (self.markers, self.landmarks, self.weights)
        )
        timecode = None if self.timecode is None else tuple(self.timecode[row] for row in rows.tolist())
        extras = _cut_extras(self.extras, rows, len(self))
        return Take(self.fps, markers, landmarks, weights, timecode, extras, self.clock[rows])

    def resampled(self, fps: float | None = None) -> Take:
        """The take with frames at an even rate over the same time, linear in between: for what needs one.

        A value is NaN where one of the two frames beside it is. Timecodes, frame numbers and texts are left out.

        Args:
            fps: frames a second; the take's own if absent.

        Raises:
            ValueRangeError: ``fps`` is no rate of a camera, or gaps are so long that nearly all frames would lie there.

        Example:
            >>> weights = Track(("jawOpen",), torch.tensor([0.0, 0.5, 1.5])[:, None, None])
            >>> take = Take(2.0, weights=weights, seconds=torch.tensor([0.0, 0.5, 1.5]))
            >>> take.resampled().weights.values.flatten().tolist()
            [0.0, 0.5, 1.0, 1.5]
        """
        fps = check_rate(self.fps if fps is None else fps, "fps", ValueRangeError)
        if self.seconds is None and fps == self.fps:
            return self
        if len(self) < 2:
            return replace(self, fps=fps, seconds=None)
        times = self.times
        check_gaps(times, fps)
        at = torch.arange(int(float(times[-1]) * fps + 1e-6) + 1, dtype=torch.float64) / fps

        def moved(values: Tensor) -> Tensor:
            return values_at(values, times.to(values.device), at.to(values.device))

        columns = {
            name: moved(column) for name, column in self.extras.get("columns", {}).items() if isinstance(column, Tensor)
        }
        return replace(self._moved(fps, moved, moved), extras={"columns": columns} if columns else {})

    def even_rows(self) -> Tensor:
        """Which frame is nearest at each moment of an even rate, (T',) int64: for pictures and players."""
        if self.seconds is None or len(self) < 2:
            return torch.arange(len(self))
        times = self.times
        check_gaps(times, self.fps)
        before, fraction = frames_beside(times, torch.arange(round(float(times[-1]) * self.fps) + 1) / self.fps)
        return before + (fraction > 0.5)

    def on_grid(self) -> tuple[Take, Tensor]:
        """The take with frames at an even rate, and which of them are its own, (T,) int64; the others show nothing.

        For methods that need an even rate and go without frames: nothing is interpolated, no value changes.

        Raises:
            ValueRangeError: gaps are so long that nearly all frames would lie there.
        """
        if self.seconds is None or len(self) < 2:
            return replace(self, seconds=None), torch.arange(len(self))
        rate, rows = frame_grid(self.seconds, self.fps)
        count = int(rows[-1]) + 1

        def spread(values: Tensor, empty: float) -> Tensor:
            return values.new_full((count, *values.shape[1:]), empty).index_copy(0, rows.to(values.device), values)

        return self._moved(rate, partial(spread, empty=torch.nan), partial(spread, empty=0.0)), rows

    def _moved(self, fps: float, values: Callable[[Tensor], Tensor], confidence: Callable[[Tensor], Tensor]) -> Take:
        """An even take of the tracks, with each one's values and confidence changed."""

        def moved(track: Track | None) -> Track | None:
            if track is None:
                return None
            sure = None if track.confidence is None else confidence(track.confidence)
            return Track(track.names, values(track.values), sure)

        return Take(fps, moved(self.markers), moved(self.landmarks), moved(self.weights))


def _frame_numbers(rows: Tensor, count: int) -> Tensor:
    """Frames (K,) int64, of numbers or of a mask."""
    if rows.dtype == torch.bool and rows.shape == (count,):
        return rows.nonzero()[:, 0]
    whole = rows.ndim == 1 and not rows.is_floating_point() and rows.dtype != torch.bool
    if not whole or not bool(((rows >= -count) & (rows < count)).all()):
        found = rows.tolist() if whole else f"{rows.dtype} {tuple(rows.shape)}"
        raise ValueRangeError(f"rows: found {found!s:.60}, expected some of {count} frames, (K,), or a mask ({count},)")
    return torch.where(rows < 0, rows + count, rows).long()


def _cut_extras(extras: dict[str, Any], rows: slice | Tensor, count: int) -> dict[str, Any]:
    """What readers keep a frame at a time, cut like the tracks."""

    def some(column: Any) -> Any:
        if isinstance(rows, Tensor) and not isinstance(column, Tensor):
            return tuple(column[row] for row in rows.tolist())
        return column[rows]

    cut = dict(extras)
    numbers = extras.get("frame_numbers")
    if numbers is not None or isinstance(rows, Tensor) or rows.start > 0:
        cut["frame_numbers"] = some(torch.arange(count) if numbers is None else numbers)
    if "columns" in extras:
        cut["columns"] = {name: some(column) for name, column in extras["columns"].items()}
    if "blendshape_count" in extras:
        cut["blendshape_count"] = some(extras["blendshape_count"])
    return cut


def empty_frames(take: Take) -> Tensor:
    """The frames in which no marker was seen, (K,) int64, rising."""
    if take.markers is None:
        raise ValueRangeError("take: found no markers, expected some")
    return take.markers.values.isnan().any(2).all(1).nonzero()[:, 0]
