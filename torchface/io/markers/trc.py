"""Marker takes in TRC files, tab-separated text of Motion Analysis and OpenSim."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.whole_files import read_file, write_file
from torchface.io.markers.marker_checks import marker_take, millimetres, unique_labels
from torchface.io.tables.csv_table import MAX_TABLE_BYTES, number_texts, parse_number, parse_numbers, quoted
from torchface.io.tables.frame_rates import frame_numbers, numbering_extras
from torchface.io.tables.track_checks import values_to_write
from torchface.number_checks import check_rate
from torchface.take import Take

_FIELDS = ("DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate", "OrigDataStartFrame")


def load_trc(path: str | Path, unit: str | None = None) -> Take:
    """Reads a TRC file; a marker whose cells are empty or NaN was not seen.

    Empty and repeated labels are made distinct (:func:`torchface.io.markers.marker_checks.unique_labels`). Frame
    numbers other than 1, 2, ... are kept in ``extras["frame_numbers"]``, dropped frames as (row, how many) in
    ``extras["gaps"]``.

    Args:
        path: the file, y up as OpenSim has it.
        unit: ``"mm"``, ``"cm"``, ``"m"`` or ``"in"``; else what the header's ``Units`` says.

    Returns:
        markers in millimetres, float32.

    Raises:
        FileFormatError: the header lacks a field, counts disagree with the rows, a row has another number of cells, or
            a cell is no number.
        ValueRangeError: ``unit`` is unknown.

    Source: OpenSim documentation, "Marker (.trc) Files".
    """
    path = Path(path)
    try:
        lines = read_file(path, MAX_TABLE_BYTES).decode("utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path}: found bytes that are no UTF-8 ({error.reason}), expected a TRC file") from error
    rows = [(number + 1, line.rstrip("\r").split("\t")) for number, line in enumerate(lines) if line.strip()]
    if len(rows) < 4 or rows[0][1][0].strip() != "PathFileType":
        raise FileFormatError(f"{path}: found no 'PathFileType' header, expected a TRC file")
    fields = dict(zip((cell.strip() for cell in rows[1][1]), (cell.strip() for cell in rows[2][1]), strict=False))
    missing = [name for name in ("DataRate", "NumFrames", "NumMarkers", "Units") if not fields.get(name)]
    if missing:
        raise FileFormatError(f"{path}: found no field {quoted(missing)}, expected it in rows 2 and 3")
    fps = check_rate(_field(fields, "DataRate", path), f"{path}: DataRate")
    factor = millimetres(fields["Units"], path, "Units", unit)
    markers = _field(fields, "NumMarkers", path)
    labels = [cell.strip() for cell in rows[3][1][2::3]]
    while labels and not labels[-1] and len(labels) > markers:
        labels.pop()
    if len(labels) != markers or markers == 0:
        raise FileFormatError(
            f"{path}: found {len(labels)} labels and NumMarkers {markers:.0f}, expected the same, not 0"
        )
    body = rows[4:]
    if body and not body[0][1][0].strip():  # X1 Y1 Z1 ...
        body = body[1:]
    if len(body) != _field(fields, "NumFrames", path) or not body:
        raise FileFormatError(
            f"{path}: found {len(body)} rows and NumFrames {fields['NumFrames'][:40]}, expected the same, not 0"
        )
    columns = ["Frame#", "Time", *(f"{axis}{i + 1}" for i in range(len(labels)) for axis in "XYZ")]
    table = np.array([_row(cells, columns, f"{path}: row {number}") for number, cells in body])
    extras = numbering_extras(table[:, 0], first=1, where=str(path))
    return marker_take(path, fps, unique_labels(labels), _scaled(table[:, 2:], factor), extras)


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
    scaled = values.reshape(len(values), -1, 3) * factor
    scaled[np.abs(scaled) > np.finfo(np.float32).max] = np.nan
    return scaled


def save_trc(take: Take, path: str | Path) -> None:
    """Writes the markers of a take as a TRC file in millimetres; what is NaN becomes empty cells.

    What else the take holds is left out.

    Args:
        take: markers (T,M,3), millimetres.
        path: the file; it appears only when it is complete.

    Raises:
        ValueRangeError: the take has no markers, infinite positions, or an absurd rate.
        NameMismatchError: a label is empty, begins or ends in a blank, or holds a tab or a line break.

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
    for row, number in enumerate(numbers):
        lines.append(f"{number}\t{(number - numbers[0]) / fps!r}\t" + "\t".join(cells[row * width : (row + 1) * width]))
    write_file(path, ("\n".join(lines) + "\n").encode("utf-8", "replace"))
