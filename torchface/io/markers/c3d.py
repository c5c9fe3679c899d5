"""Marker takes in C3D files.

The point data are read and written as whole arrays. The ``c3d`` package, which goes frame by frame, refuses files whose
header and parameters differ in what no reader needs, and cannot write more than 255 or non-ASCII labels, is the
tests' second opinion.

Source: The C3D File Format User Guide, Motion Lab Systems.
"""

import re
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.files.whole_files import read_file, write_file
from torchface.io.markers.c3d_sections import (
    BLOCK,
    MIPS,
    Header,
    Parameter,
    Sections,
    floats,
    pack_sections,
    read_sections,
)
from torchface.io.markers.marker_checks import marker_take, millimetres, unique_labels
from torchface.io.tables.csv_table import quoted
from torchface.io.tables.frame_rates import FrameTimes, frame_numbers, simplest_rate
from torchface.io.tables.track_checks import values_to_write
from torchface.number_checks import check_rate
from torchface.take import Take

_MAX_COUNT = 65535
_MAX_PARAMETER_BYTES = 32000  # bytes: many readers take the offset to the next one for a signed 16-bit number
_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


def load_c3d(path: str | Path, unit: str | None = None) -> Take:
    """Reads the points of a C3D file: integers or floats, of Intel, DEC or SGI/MIPS processors.

    A point whose residual is negative or NaN, or one of whose coordinates is no number, was not seen: NaN.
    ``POINT:X_SCREEN`` and ``Y_SCREEN`` say which of the file's axes point right and up; where they are given, the
    points are turned to y up. Labels come from ``POINT:LABELS``, ``LABELS2``, ...; empty and repeated ones are made
    distinct (:func:`torchface.io.markers.marker_checks.unique_labels`). A first frame after frame 1 is kept in
    ``extras["frame_numbers"]``, which count from 0. Analog channels are skipped.

    Args:
        unit: ``"mm"``, ``"cm"``, ``"m"`` or ``"in"``; else what ``POINT:UNITS`` says.

    Returns:
        markers in millimetres, float32.

    Source: The C3D File Format User Guide, Motion Lab Systems.
    """
    path = Path(path)
    data = read_file(path)
    sections = read_sections(data, path)
    points = _number(sections, "POINT:USED", sections.header.points)
    if points != sections.header.points:
        raise FileFormatError(
            f"{path}: found POINT:USED {points:.0f}, expected {sections.header.points} as in the header"
        )
    if points == 0:
        raise FileFormatError(f"{path}: found no points (POINT:USED is 0), expected at least one")
    file_unit = "".join(sections.texts("POINT:UNITS")[:1])
    factor = millimetres(file_unit, path, "POINT:UNITS", unit)
    fps = check_rate(_number(sections, "POINT:RATE", sections.header.rate), f"{path}: POINT:RATE")
    fps = simplest_rate(fps, lambda rate: np.float32(rate) == np.float32(fps))
    axes = _axes(sections, path)
    positions = _positions(data, sections, path).astype(np.float64) * factor
    if axes is not None:
        positions = positions @ axes.T
    positions[np.abs(positions) > np.finfo(np.float32).max] = np.nan
    first = _first_frame(sections) - 1
    extras = {"frame_numbers": torch.arange(first, first + len(positions))} if first > 0 else {}
    return marker_take(path, FrameTimes(fps, None), _labels(sections, int(points)), positions, extras, factor)


def _number(sections: Sections, name: str, default: float) -> float:
    return (sections.numbers(name) or [default])[0]


def _first_frame(sections: Sections) -> int:
    low_high = sections.numbers("TRIAL:ACTUAL_START_FIELD")
    if len(low_high) >= 2 and all(float(number).is_integer() for number in low_high[:2]):
        return int(low_high[0]) + 65536 * int(low_high[1])
    return sections.header.first_frame


def _frame_counts(sections: Sections, stored: int, path: Path) -> list[float]:
    """What the file's fields say, the most reliable first; 16 bits of them end at 65,535 or begin again from 0."""
    header = sections.header
    last = sections.numbers("TRIAL:ACTUAL_END_FIELD")
    stated = sections.numbers("POINT:LONG_FRAMES")[:1] + sections.numbers("POINT:FRAMES")[:1]
    counts = [last[0] + 65536 * last[1] - _first_frame(sections) + 1] if len(last) >= 2 else []
    counts += [count for count in stated if count > _MAX_COUNT]
    if header.last_frame == _MAX_COUNT:
        said = _MAX_COUNT - header.first_frame + 1
        if not counts and stored > said:
            warnings.warn(
                f"{path}: found {stored} frames stored and {said} announced, where 16 bits count no further: all are "
                "read; if the take is no longer than announced, the last ones are bytes of another kind",
                stacklevel=5,
            )
        return [*counts, stored, *stated]
    count = (header.last_frame - header.first_frame + 1) % 65536
    return [*counts, 65536 if count == 0 and stored > _MAX_COUNT else count, *stated]


def _positions(data: bytes, sections: Sections, path: Path) -> np.ndarray:
    """The points (T,M,3) in the file's unit and axes, NaN where not seen."""
    header = sections.header
    scale = _number(sections, "POINT:SCALE", header.scale)
    if not np.isfinite(scale) or scale == 0:
        raise FileFormatError(f"{path}: POINT:SCALE: found {scale}, expected a number other than 0")
    word = 4 if scale < 0 else 2
    first_block = header.data_block or _number(sections, "POINT:DATA_START", 0)
    if not (2 <= first_block <= _MAX_COUNT and float(first_block).is_integer()):
        raise FileFormatError(f"{path}: found the data in block {first_block:g}, expected block 3 or later")
    start = BLOCK * (int(first_block) - 1)
    frame_size = word * (4 * header.points + header.analog)
    stored = max(0, len(data) - start) // frame_size
    zeros = BLOCK - len(data[-BLOCK:].rstrip(b"\0"))  # that fill the last block, or the end of the last frame
    full = min(stored, -((start - len(data) + zeros) // frame_size))
    counts = [count for count in _frame_counts(sections, full, path) if count >= 1 and float(count).is_integer()]
    if not counts:
        raise FileFormatError(f"{path}: found no frames, expected at least one")
    fitting = [int(count) for count in counts if count <= stored]
    if not fitting:
        raise FileFormatError(
            f"{path}: found {counts[0]:.0f} frames of {frame_size} bytes announced and space for {stored} behind byte "
            f"{start}, expected all of them; is the file cut off?"
        )
    frames = fitting[0]
    if frames <= _MAX_COUNT:
        frames += (stored - frames) // 65536 * 65536  # 16 bits began again
    rows = np.frombuffer(data, np.uint8, frames * frame_size, start).reshape(frames, frame_size)
    block = np.ascontiguousarray(rows[:, : 4 * word * header.points])
    if word == 4:
        values = floats(block.reshape(-1), sections.processor).reshape(frames, header.points, 4)
        positions = values[..., :3].copy()
    else:
        values = block.view(">i2" if sections.processor == MIPS else "<i2").reshape(frames, header.points, 4)
        positions = (values[..., :3] * np.float64(scale)).astype(np.float32)
    with np.errstate(invalid="ignore"):
        positions[~(values[..., 3] >= 0)] = np.nan
    positions[~np.isfinite(positions)] = np.nan
    return positions


def _labels(sections: Sections, points: int) -> tuple[str, ...]:
    found = [re.fullmatch(r"POINT:LABELS([0-9]{0,3})", name) for name in sections.parameters]
    groups = sorted((int(one[1] or 1), one[0]) for one in found if one)
    labels = [label.strip() for _, name in groups for label in sections.texts(name)][:points]
    return unique_labels(labels + [""] * (points - len(labels)))


def _axes(sections: Sections, path: Path) -> np.ndarray | None:
    """The rows x right, y up, z toward the viewer in the file's axes (3,3); None where it does not say."""
    right, up = ("".join(sections.texts(f"POINT:{name}_SCREEN")[:1]).strip().upper() for name in "XY")
    if not right or not up:
        return None
    rows = []
    for name, text in (("X_SCREEN", right), ("Y_SCREEN", up)):
        match = re.fullmatch(r"([+-]?)([XYZ])", text)
        if match is None:
            raise FileFormatError(f"{path}: POINT:{name}: found {quoted([text])}, expected an axis such as +X or -Z")
        rows.append((-1.0 if match[1] == "-" else 1.0) * np.array(_AXES[match[2]]))
    if abs(rows[0] @ rows[1]) > 0:
        raise FileFormatError(f"{path}: found X_SCREEN {right!r} and Y_SCREEN {up!r}, expected two different axes")
    return np.stack([*rows, np.cross(rows[0], rows[1])])


def save_c3d(take: Take, path: str | Path) -> None:
    """Writes the markers of a take as a C3D file: Intel floats, millimetres, y up; what is NaN gets residual -1.

    What else the take holds is left out. Frame numbers that ``load_c3d`` kept are written again. Frames that were
    dropped are written as frames that show nothing, for C3D has one rate.

    Args:
        take: markers (T,M,3), millimetres, at most 65,535; labels of at most 255 bytes.

    Source: The C3D File Format User Guide, Motion Lab Systems.
    """
    path = Path(path)
    numbers = frame_numbers(take, first=1)
    if take.seconds is not None:  # C3D has one rate: frames that were dropped are frames that show nothing
        first, given = numbers[0], take
        take, _ = given.on_grid()
        if take.fps != given.fps:
            raise ValueRangeError(
                f"{path}: found frames {given.rate}, expected an even rate for C3D: write .csv or .trc, or "
                "take.resampled()"
            )
        numbers = range(first, first + len(take))
    labels, positions = values_to_write(take.markers, "marker positions", 3, path)
    fps = check_rate(take.fps, f"{path}: the take", ValueRangeError)
    frames, points = positions.shape[:2]
    first, last = numbers[0], numbers[0] + frames - 1
    if numbers[-1] != last or first < 1:  # C3D numbers its frames without gaps
        first, last = 1, frames
    if points > _MAX_COUNT or last > 2**32 - 1:
        raise ValueRangeError(
            f"{path}: found {points} points up to frame {last}, expected at most {_MAX_COUNT} and 2^32 - 1"
        )
    header = Header(points, 0, first, last, -1.0, 0, fps)
    head = pack_sections(header, _groups(labels, header, frames, path), path)
    data = np.zeros((frames, points, 4), "<f4")
    unseen = np.isnan(positions[..., 0])
    data[..., :3] = np.where(unseen[..., None], 0, positions)
    data[unseen, 3] = -1
    body = data.tobytes()
    write_file(path, head + body + bytes(-len(body) % BLOCK))


def _groups(labels: Sequence[str], header: Header, frames: int, path: Path) -> dict[str, dict[str, Parameter]]:
    point = {
        "USED": Parameter(2, (), struct.pack("<H", header.points)),
        "SCALE": Parameter(4, (), struct.pack("<f", header.scale)),
        "RATE": Parameter(4, (), struct.pack("<f", header.rate)),
        "FRAMES": Parameter(2, (), struct.pack("<H", min(frames, _MAX_COUNT))),
        "UNITS": Parameter(-1, (2,), b"mm"),
        "X_SCREEN": Parameter(-1, (2,), b"+X"),
        "Y_SCREEN": Parameter(-1, (2,), b"+Y"),
        **_label_parameters(labels, path),
    }
    if frames > _MAX_COUNT:
        point["LONG_FRAMES"] = Parameter(4, (), struct.pack("<f", frames))
    trial = {
        "ACTUAL_START_FIELD": Parameter(2, (2,), struct.pack("<I", header.first_frame)),
        "ACTUAL_END_FIELD": Parameter(2, (2,), struct.pack("<I", header.last_frame)),
    }
    analog = {
        "USED": Parameter(2, (), struct.pack("<H", 0)),
        "GEN_SCALE": Parameter(4, (), struct.pack("<f", 1.0)),
        "SCALE": Parameter(4, (0,), b""),
        "OFFSET": Parameter(2, (0,), b""),
        "RATE": Parameter(4, (), struct.pack("<f", 0.0)),
    }
    return {"TRIAL": trial, "POINT": point, "ANALOG": analog}


def _label_parameters(labels: Sequence[str], path: Path) -> dict[str, Parameter]:
    """LABELS, LABELS2, ... of up to 255 texts each, and the empty descriptions that go with them."""
    texts = [label.encode("utf-8") for label in labels]
    long = [label for label, text in zip(labels, texts, strict=True) if len(text) > 255]
    if long:
        raise NameMismatchError(f"{path}: found the label {quoted(long)}, expected at most 255 bytes each")
    width = max(map(len, texts))
    per_parameter = min(255, _MAX_PARAMETER_BYTES // width)
    parameters = {}
    for i in range(0, len(texts), per_parameter):
        some, number = texts[i : i + per_parameter], "" if i == 0 else str(i // per_parameter + 1)
        joined = b"".join(text.ljust(width) for text in some)
        parameters[f"LABELS{number}"] = Parameter(-1, (width, len(some)), joined)
        parameters[f"DESCRIPTIONS{number}"] = Parameter(-1, (1, len(some)), b" " * len(some))
    return parameters
