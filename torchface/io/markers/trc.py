"""Marker takes in TRC files, tab-separated text of Motion Analysis and OpenSim."""

import warnings
from array import array
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.whole_files import read_file, write_file
from torchface.io.markers.marker_checks import marker_take, millimetres, unique_labels
from torchface.io.tables.csv_table import MAX_TABLE_BYTES, TextLines, number_texts, parse_number, parse_numbers, quoted
from torchface.io.tables.frame_rates import TimeSource, file_error, frame_numbers, frame_times, numbering_extras
from torchface.io.tables.track_checks import values_to_write
from torchface.number_checks import check_rate
from torchface.take import Take

_FIELDS = ("DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate", "OrigDataStartFrame")


def load_trc(path: str | Path, unit: str | None = None) -> Take:
    """Reads a TRC file, in millimetres, float32; a marker whose cells are empty or NaN was not seen.

    Empty and repeated labels are made distinct (:func:`torchface.io.markers.marker_checks.unique_labels`). Frame
    numbers other than 1, 2, ... are kept in ``extras["frame_numbers"]``, counted from 0; frames that come
    unevenly keep their times.

    Args:
        path: the file, y up as OpenSim has it.
        unit: ``"mm"``, ``"cm"``, ``"m"`` or ``"in"``; else what the header's ``Units`` says.

    Source: OpenSim documentation, "Marker (.trc) Files".
    """
    path = Path(path)
    data = read_file(path, MAX_TABLE_BYTES)
    lines = _filled_lines(path, data)
    head = [line.split("\t") for _, line in islice(lines, 4)]
    if len(head) < 4 or head[0][0].strip() != "PathFileType":
        raise FileFormatError(f"{path}: found no 'PathFileType' header, expected a TRC file")
    fields = dict(zip((cell.strip() for cell in head[1]), (cell.strip() for cell in head[2]), strict=False))
    missing = [name for name in ("DataRate", "NumFrames", "NumMarkers", "Units") if not fields.get(name)]
    if missing:
        raise FileFormatError(f"{path}: found no field {quoted(missing)}, expected it in rows 2 and 3")
    fps = check_rate(_field(fields, "DataRate", path), f"{path}: DataRate")
    factor = millimetres(fields["Units"], path, "Units", unit)
    markers = _field(fields, "NumMarkers", path)
    labels = [cell.strip() for cell in head[3][2::3]]
    while labels and not labels[-1] and len(labels) > markers:
        labels.pop()
    if len(labels) != markers or markers == 0:
        raise FileFormatError(
            f"{path}: found {len(labels)} labels and NumMarkers {markers:.0f}, expected the same, not 0"
        )
    first = next(lines, None)
    named = first is not None and not first[1].split("\t", 1)[0].strip()  # X1 Y1 Z1 ...
    count = sum(1 for _ in lines) + (first is not None) - named
    if count == 0 or count != _field(fields, "NumFrames", path):
        raise FileFormatError(
            f"{path}: found {count} rows and NumFrames {fields['NumFrames'][:40]}, expected the same, not 0"
        )
    columns = ["Frame#", "Time", *(f"{axis}{i + 1}" for i in range(len(labels)) for axis in "XYZ")]
    numbers = array("d")
    for number, line in islice(_filled_lines(path, data), 4 + named, None):  # text comes by the line
        numbers.extend(_row(line.split("\t"), columns, f"{path}: row {number}"))
    table = np.frombuffer(numbers).reshape(count, len(columns))
    extras = numbering_extras(table[:, 0], first=1, where=str(path))
    times = frame_times(table[:, 1], TimeSource(file_error(path), table[:, 0], fps))
    if count > 1 and not 0.9 < times.fps / fps < 1.1:
        warnings.warn(
            f"{path}: found DataRate {fps:g} and times of {times.fps:g} frames a second, expected the same: "
            "the times count",
            stacklevel=2,
        )
    return marker_take(path, times, unique_labels(labels), _scaled(table[:, 2:], factor), extras, factor)


def _filled_lines(path: Path, data: bytes) -> Iterator[tuple[int, str]]:
    """The lines that hold more than blanks, with their numbers from 1."""
    lines = TextLines(path, data, newline="\n")
    for number, line in enumerate(lines, 1):
        lines.row_begins()
        if line.strip():
            yield number, line.rstrip("\r\n")


def _field(fields: dict[str, str], name: str, path: Path) -> float:
    value = parse_number(fields[name])
    if value is None or not value >= 0:
        raise FileFormatError(f"{path}: {name}: found {quoted([fields[name]])}, expected a number")
    return value


def _row(cells: list[str], columns: list[str], where: str) -> list[float]:
    while len(cells) > len(columns) and not cells[-1].strip():
        cells.pop()
    if len(cells) != len(columns):
        raise FileFormatError(f"{where}: found {len(cells)} cells, expected {len(columns)}")
    return parse_numbers(cells, columns, where)


def _scaled(values: np.ndarray, factor: float) -> np.ndarray:
    values *= factor
    with np.errstate(over="ignore"):  # what is too large becomes infinite, which is no position
        return values.astype(np.float32).reshape(len(values), -1, 3)


def save_trc(take: Take, path: str | Path) -> None:
    """Writes the markers of a take, nothing else of it, as a TRC file in millimetres; what is NaN becomes empty cells.

    Source: OpenSim documentation, "Marker (.trc) Files".
    """
    path = Path(path)
    labels, positions = values_to_write(take.markers, "marker positions", 3, path)
    fps = check_rate(take.fps, f"{path}: the take", ValueRangeError)
    frames, markers = positions.shape[:2]
    numbers = frame_numbers(take, first=1)
    values = [repr(fps), repr(fps), str(frames), str(markers), "mm", repr(fps), str(numbers[0]), str(frames)]
    axes = "".join(f"\tX{i}\tY{i}\tZ{i}" for i in range(1, markers + 1))
    name = " ".join(path.name.split())  # a tab or line break in the name would break the header
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "\t".join((*_FIELDS, "OrigNumFrames")),
        "\t".join(values),
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t" + axes,
        "",
    ]
    cells = number_texts(positions.reshape(-1))
    width = 3 * markers
    times = [(number - numbers[0]) / fps for number in numbers] if take.seconds is None else take.seconds.tolist()
    for row, number in enumerate(numbers):
        lines.append(f"{number}\t{times[row]!r}\t" + "\t".join(cells[row * width : (row + 1) * width]))
    write_file(path, ("\n".join(lines) + "\n").encode("utf-8", "replace"))
