"""A marker take from disk: in millimetres, by an attachment's labels, cut to some frames."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers import match_labels, own_labels
from torchface.capture.markers.rig_fit_check import unit_of_scale
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.escaped_text import listed
from torchface.geometry.similarity import MAX_HEAD_SCALE, MIN_HEAD_SCALE
from torchface.io import load_take
from torchface.io.markers.marker_csv import is_marker_header
from torchface.io.tables.csv_table import CellRows, TableReader, quoted
from torchface.io.take_files import MARKER_ENDINGS
from torchface.take import Take, Track
from torchface.workflows.batch.batch_items import ItemKind

# Of the six real takes on ICT's rig, with slip, gaps, 0.3 mm of noise and 12 to 100 markers, the scale is 1 within
# 0.0024; with markers 2 mm off the skin 0.988, with two labels exchanged in 9 % of the frames 1 within 0.0015.
MAX_SCALE_DIFFERENCE = 0.01  # a take of the rig's own performer in true units fits it at scale 1, within this

_AXES = "xyz"
_SPAN = re.compile(r"\s*(\d{0,9})\s*:\s*(\d{0,9})\s*")


@dataclass(frozen=True)
class MarkerOptions:
    """How a marker file is read."""

    unit: str | None = None  # of its coordinates; what the file says if absent
    labels: Path | None = None  # a table that maps the take's labels to the attachment's
    frames: str | None = None  # A:B, the frames from A up to, not including, B; all if absent
    flip: str | None = None  # x, y or z, the axis whose coordinates are negated: a take in left-handed axes is mirrored
    # Of an alignment with the rig: held at 1 or free; held where the unit is known, if absent.
    scale: Literal["held", "free"] | None = None

    def frees_scale(self, path: Path) -> bool:
        """Whether an alignment estimates the scale of the markers in this file: C3D and TRC state their unit."""
        if self.scale is not None:
            return self.scale == "free"
        return self.unit is None and path.suffix.lower() not in MARKER_ENDINGS


DEFAULT_OPTIONS = MarkerOptions()  # in the file's own unit, by its own labels, all frames


def is_marker_take(path: Path) -> bool:
    """Whether a file holds markers, by its ending and header."""
    ending = path.suffix.lower()
    return ending in MARKER_ENDINGS or (ending == ".csv" and is_marker_header(TableReader(path).header))


MARKER_TAKES = ItemKind("take", "solved", (*MARKER_ENDINGS, ".csv"), is_marker_take)
"""What commands that work on markers look for in folders."""


def read_markers(path: Path, labels: Sequence[str] | None, options: MarkerOptions) -> tuple[Take, list[str]]:
    """The take with the markers of an attachment alone, or all labelled ones of the file, all frames; and remarks
    for the user."""
    take = load_take(path, options.unit)
    if take.markers is None:
        other = "; such weights go to another rig by torchface retarget" if take.weights is not None else ""
        held = ", ".join(
            f"{len(track.names)} {kind}" for kind in ("weights", "landmarks") if (track := getattr(take, kind))
        )
        raise ValueRangeError(f"{path}: found {held or 'no markers'}, expected a marker take (.c3d, .trc, .csv){other}")
    renamed = None if options.labels is None else load_label_map(options.labels)
    try:
        names = take.markers.names
        match = own_labels(names, renamed) if labels is None else match_labels(names, labels, renamed)
    except NameMismatchError as error:
        raise NameMismatchError(f"{path}: {error}") from error
    chosen = take.markers.select(match.channels)
    values = chosen.values if options.flip is None else _flipped(chosen.values, options.flip)
    markers, extras = Track(match.labels, values, chosen.confidence), {**take.extras, "flipped": options.flip}
    notes, shown = match.notes(), torch.isfinite(values).all(-1).any(0).tolist()
    seen = {name for name, is_shown in zip(match.labels, shown, strict=True) if is_shown}
    never = [label for label in labels or () if label not in seen]
    if never:
        notes.append(f"no frame shows {listed(never)}, of the attachment's {len(labels or ())} markers")
    return replace(take, markers=markers, extras=extras), notes


def _flipped(values: Tensor, axis: str) -> Tensor:
    """Markers (T,M,3) with one coordinate negated."""
    if axis not in _AXES:
        raise ValueRangeError(f"--flip: found {axis!r}, expected x, y or z")
    return values * torch.tensor([-1.0 if name == axis else 1.0 for name in _AXES]).to(values)


def scale_warnings(scale: float, held: bool, read_as: str | None = None) -> list[str]:
    """Warnings where the scale that fits a take to its performer's rig best is not 1, also of a take that is
    ``held`` at 1."""
    if abs(scale - 1) <= MAX_SCALE_DIFFERENCE:
        return []
    unit = unit_of_scale(scale, read_as) if not MIN_HEAD_SCALE <= scale <= MAX_HEAD_SCALE else ""
    why = (
        f"the take seems to be in {unit} (--unit {unit})"
        if unit
        else "the take's unit, its labels or the rig are others, or the markers' centres stand off the skin "
        "(attach --standoff)"
    )
    more = "; it was held at 1: --scale free takes the other" if held else ""
    return [
        f"the take fits the rig at {scale:.4g} times its size, expected 1 within {100 * MAX_SCALE_DIFFERENCE:g} %: "
        f"{why}{more}"
    ]


def read_range_of_motion(
    path: Path, initial: Attachment | None, options: MarkerOptions
) -> tuple[Take, Attachment | None, list[str]]:
    """The frames of a range of motion with the markers that are seen in them, the sites of these, and remarks."""
    take, notes = read_markers(path, None if initial is None else initial.labels, options)
    take = take.frames(frame_span(options.frames, take))
    assert take.markers is not None
    seen = (~torch.isnan(take.markers.values).any(-1)).any(0).tolist()
    labels = [name for name, shown in zip(take.markers.names, seen, strict=True) if shown]
    unseen = [name for name in (take.markers.names if initial is None else initial.labels or ()) if name not in labels]
    if unseen:
        notes.append(f"no site for {listed(unseen)}: seen in no frame")
    sites = None if initial is None else initial.select(labels)
    return replace(take, markers=take.markers.select(labels)), sites, notes


def frame_span(frames: str | None, take: Take) -> slice:
    """The rows of a take that ``A:B`` means by its frame numbers."""
    if frames is None:
        return slice(0, len(take))
    match = _SPAN.fullmatch(frames)
    if match is None:
        raise ValueRangeError(f"--frames: found {frames!r}, expected A:B, such as 120:900, 120: or :900")
    low, high = take.numbers[[0, -1]].tolist()
    first, last = int(match[1] or low), min(int(match[2] or high + 1), high + 1)
    rows = slice(*torch.searchsorted(take.numbers, torch.tensor([first, last])).tolist())
    if first < low or rows.start >= rows.stop:  # a take may lack frames in between
        raise ValueRangeError(
            f"--frames: found {frames!r} in a take of {len(take)} frames, numbered {low} to {high}, expected A < B, "
            f"A from {low} to {high}, and frames from A to B"
        )
    return rows


def row_of(frame: int, numbers: Tensor) -> int:
    """Where the frame that --neutral names is among those that are used, by their numbers (T,)."""
    row = int(torch.searchsorted(numbers, frame))
    if row == len(numbers) or int(numbers[row]) != frame:
        raise ValueRangeError(
            f"--neutral: found frame {frame}, expected one of those that are used, {int(numbers[0])} to "
            f"{int(numbers[-1])}"
        )
    return row


HEADER = ("take", "attachment")
_MAX_BYTES = 2**22


def load_label_map(path: str | Path) -> dict[str, str]:
    """Reads CSV of two columns, the take's label and the attachment's::

        take,attachment
        LBrowIn,M001
        helmet_front,
        Jane:*,

    Semicolons may stand for commas, and the heading may be left out; an empty second cell leaves the marker out, or all
    markers of a subject.
    """
    renamed: dict[str, str] = {}
    rows = CellRows(path, _MAX_BYTES)
    for index, row in enumerate(rows):
        cells = [cell.strip() for cell in row]
        if not any(cells) or (index == 0 and tuple(cell.lower() for cell in cells) == HEADER):
            continue
        if len(cells) != 2 or not cells[0]:
            raise FileFormatError(
                f"{path}: row {rows.number}: found {quoted(cells)}, expected two cells: a label of the take, and the "
                "attachment's"
            )
        if cells[0] in renamed:
            raise FileFormatError(f"{path}: row {rows.number}: found {cells[0]!r} again, expected each label once")
        renamed[cells[0]] = cells[1]
    if not renamed:
        raise FileFormatError(f"{path}: found no row, expected a label of the take and of the attachment in each")
    return renamed
