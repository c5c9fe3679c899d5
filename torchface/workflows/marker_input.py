"""A marker take from disk: in millimetres, by an attachment's labels, cut to some frames."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers import match_labels, own_labels
from torchface.capture.markers.rig_fit_check import unit_of_scale
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.geometry.similarity import MAX_HEAD_SCALE, MIN_HEAD_SCALE, Similarity
from torchface.io import load_take
from torchface.io.markers.label_maps import load_label_map
from torchface.io.markers.marker_csv import is_marker_header
from torchface.io.tables.csv_table import TableReader
from torchface.io.take_files import MARKER_ENDINGS
from torchface.take import Take, Track
from torchface.workflows.batch.batch_items import ItemKind

_SHOWN = 6
_AXES = "xyz"
_SPAN = re.compile(r"\s*(\d{0,9})\s*:\s*(\d{0,9})\s*")


@dataclass(frozen=True)
class MarkerOptions:
    """How a marker file is read.

    Args:
        unit: of its coordinates; what the file says if absent.
        labels: a table that maps the take's labels to the attachment's.
        frames: ``A:B``, the frames from A up to, not including, B; all if absent.
        flip: ``x``, ``y`` or ``z``, the axis whose coordinates are negated: a take in left-handed axes is mirrored.
    """

    unit: str | None = None
    labels: Path | None = None
    frames: str | None = None
    flip: str | None = None


DEFAULT_OPTIONS = MarkerOptions()
"""In the file's own unit, by its own labels, all frames."""


def is_marker_take(path: Path) -> bool:
    """Whether a file holds markers, by its ending and header."""
    ending = path.suffix.lower()
    return ending in MARKER_ENDINGS or (ending == ".csv" and is_marker_header(TableReader(path).header))


MARKER_TAKES = ItemKind("take", "solved", (*MARKER_ENDINGS, ".csv"), is_marker_take)
"""What commands that work on markers look for in folders."""


def read_markers(path: Path, labels: Sequence[str] | None, options: MarkerOptions) -> tuple[Take, list[str]]:
    """The take with the markers of an attachment alone, by its labels, all frames; and remarks for the user.

    Args:
        path: ``.c3d``, ``.trc`` or ``.csv``.
        labels: the attachment's; all labelled markers of the file where there is none.
        options: unit and label map.

    Raises:
        ValueRangeError: the file holds no markers.
        NameMismatchError: its labels are not the attachment's.
        FileFormatError: a file is damaged.
    """
    take = load_take(path, options.unit)
    if take.markers is None:
        other = "; such weights go to another rig by torchface retarget" if take.weights is not None else ""
        held = ", ".join(
            f"{len(track.names)} {kind}" for kind in ("weights", "landmarks") if (track := getattr(take, kind))
        )
        raise ValueRangeError(f"{path}: found {held or 'no markers'}, expected a marker take (.c3d, .trc, .csv){other}")
    renamed = None if options.labels is None else load_label_map(options.labels)
    try:
        found = take.markers.names
        match = own_labels(found, renamed) if labels is None else match_labels(found, labels, renamed)
    except NameMismatchError as error:
        raise NameMismatchError(f"{path}: {error}") from error
    chosen = take.markers.select(match.channels)
    values = chosen.values if options.flip is None else _flipped(chosen.values, options.flip)
    return replace(take, markers=Track(match.labels, values, chosen.confidence)), match.notes()


def _flipped(values: Tensor, axis: str) -> Tensor:
    """Markers (T,M,3) with one coordinate negated."""
    if axis not in _AXES:
        raise ValueRangeError(f"--flip: found {axis!r}, expected x, y or z")
    return values * torch.tensor([-1.0 if name == axis else 1.0 for name in _AXES]).to(values)


def pose_warnings(alignment: Similarity) -> list[str]:
    """Warnings where the scale of a take's alignment with a rig is no head's."""
    scale = float(alignment.scale[0])
    if MIN_HEAD_SCALE <= scale <= MAX_HEAD_SCALE:
        return []
    unit = unit_of_scale(scale)
    why = f"the take seems to be in {unit} (--unit {unit})" if unit else "the labels, the take or the rig are others"
    return [
        f"the take fits the rig at {scale:.3g} times its size, heads differ by {MIN_HEAD_SCALE} to {MAX_HEAD_SCALE} "
        f"times: {why}"
    ]


def read_range_of_motion(
    path: Path, initial: Attachment | None, options: MarkerOptions
) -> tuple[Take, Attachment | None, list[str]]:
    """The frames of a range of motion with the markers that are seen in them, the sites of these, and remarks.

    Args:
        path: ``.c3d``, ``.trc`` or ``.csv``.
        initial: sites to begin with, if there are any.
        options: unit, label map, frames.

    Raises:
        TorchfaceError: as ``read_markers`` and ``frame_span``.
    """
    take, notes = read_markers(path, None if initial is None else initial.labels, options)
    take = take.frames(frame_span(options.frames, len(take)))
    assert take.markers is not None
    seen = (~torch.isnan(take.markers.values).any(-1)).any(0).tolist()
    labels = [name for name, shown in zip(take.markers.names, seen, strict=True) if shown]
    unseen = [name for name in (take.markers.names if initial is None else initial.labels or ()) if name not in labels]
    if unseen:
        more = f" and {len(unseen) - _SHOWN} more" if len(unseen) > _SHOWN else ""
        notes.append(f"no site for {', '.join(unseen[:_SHOWN])}{more}: seen in no frame")
    sites = None if initial is None else initial.select(labels)
    return replace(take, markers=take.markers.select(labels)), sites, notes


def frame_span(frames: str | None, count: int) -> slice:
    """The rows that ``A:B`` means of a take of ``count`` frames.

    Raises:
        ValueRangeError: it is another text, or leaves no frame.
    """
    if frames is None:
        return slice(0, count)
    match = _SPAN.fullmatch(frames)
    if match is None:
        raise ValueRangeError(f"--frames: found {frames!r}, expected A:B, such as 120:900, 120: or :900")
    first, last = int(match[1] or 0), min(int(match[2] or count), count)
    if first >= last:
        raise ValueRangeError(f"--frames: found {frames!r} in a take of {count} frames, expected A < B and A < {count}")
    return slice(first, last)
