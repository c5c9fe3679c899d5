"""Marker takes as plain CSV: ``frame,time,<label>_x,<label>_y,<label>_z,...``."""

import re
from collections.abc import Sequence
from pathlib import Path

from torchface.errors import FileFormatError
from torchface.io.markers.marker_checks import marker_take, millimetres
from torchface.io.tables.csv_table import TableReader, quoted
from torchface.io.tables.numbered_csv import is_numbered, read_numbered, write_numbered
from torchface.io.tables.track_checks import values_to_write
from torchface.take import Take

_AXES = ("_x", "_y", "_z")
_SEPARATED = re.compile(r".*[_.:\- ][xyzXYZ]", re.DOTALL)
_CHANNEL = re.compile(r"(.+?)[_.:\- ]?([xyzXYZ])", re.DOTALL)


def is_marker_header(header: Sequence[str]) -> bool:
    """Whether a header looks like markers: most of its channels end in ``_x``, ``.y``, ``:Z`` and the like, or all of
    them are triples that end so without a separator."""
    channels = header[2:]
    if not is_numbered(header) or not channels:
        return False
    if 2 * sum(_SEPARATED.fullmatch(name) is not None for name in channels) > len(channels):
        return True
    labels = _labels(channels)
    return labels is not None and len(channels) == 3 * len(labels)


def load_markers_csv(path: str | Path, unit: str | None = None) -> Take:
    """Reads markers from CSV with the header ``frame,time,<label>_x,<label>_y,<label>_z,...``; also ``<label>.x``,
    ``<label>:X``, ``<label> X``, ``<label>X``.

    One row a frame; times in seconds; an empty cell is a marker not seen. The rate is that of numbers and times;
    frames that come unevenly keep their times. Numbers other than 0, 1, ... go to ``extras["frame_numbers"]``.

    Args:
        path: the file, y up.
        unit: ``"mm"`` (if absent), ``"cm"``, ``"m"`` or ``"in"``.

    Returns:
        markers in millimetres, float32.
    """
    path = Path(path)
    factor = millimetres("mm", path, "unit", unit)
    reader = TableReader(path)
    found = _labels(reader.header[2:])
    if not is_numbered(reader.header) or found is None:
        raise FileFormatError(
            f"{path}: found the columns {quoted(reader.header)}, expected frame,time,<label>_x,<label>_y,<label>_z,..."
        )
    labels = tuple(found)
    columns = [found[label].get(axis, f"{label}_{axis}") for label in labels for axis in "xyz"]
    reader.require(columns)
    table, times, extras = read_numbered(reader)
    positions = table.columns(columns).reshape(-1, len(labels), 3)
    positions *= factor
    del table  # a long take fits the memory once, not three times
    return marker_take(path, times, labels, positions, extras, factor)


def _labels(channels: Sequence[str]) -> dict[str, dict[str, str]] | None:
    """The columns of each label by axis; none where a channel ends in no axis, or stands twice."""
    labels: dict[str, dict[str, str]] = {}
    for channel in channels:
        match = _CHANNEL.fullmatch(channel)
        if match is None:
            return None
        axes = labels.setdefault(match[1], {})
        if axes.setdefault(match[2].lower(), channel) != channel:
            return None
    return labels


def save_markers_csv(take: Take, path: str | Path) -> None:
    """Writes the markers of a take, and nothing else of it, as CSV in millimetres; what is NaN becomes empty cells."""
    path = Path(path)
    labels, positions = values_to_write(take.markers, "marker positions", 3, path)
    write_numbered(
        take, path, [label + axis for label in labels for axis in _AXES], positions.reshape(len(positions), -1)
    )
