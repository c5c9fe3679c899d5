"""Live Link Face's CSV: timecode, ARKit's 52 weights, head and eye rotations."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io.tables.csv_table import TableReader, parse_number, quoted, write_table
from torchface.io.tables.frame_rates import frame_numbers
from torchface.io.tables.numbered_csv import is_numbered
from torchface.io.tables.timecode import read_timecodes, timecodes_at, write_timecodes
from torchface.io.tables.track_checks import kept_columns, values_to_write
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.number_checks import check_rate
from torchface.shape_names import ARKIT, mapping, spelled_as
from torchface.take import Take, Track

_TIMECODE, _COUNT = "timecode", "blendshapecount"
_MOST_LACKING = len(ARKIT) // 2  # columns of another kind of file
_SHAPES = {name.lower() for name in ARKIT}


def is_live_link(header: Sequence[str]) -> bool:
    """Whether a header is Live Link Face's."""
    return not is_numbered(header) and bool({_TIMECODE, _COUNT} & {name.lower() for name in header})


def are_live_link_shapes(names: Sequence[str]) -> bool:
    """Whether names are ARKit's 52, all of them and no other, in whatever order and case."""
    return len(names) == len(ARKIT) and {name.lower() for name in names} == _SHAPES


def not_in_live_link(names: Sequence[str]) -> tuple[str, ...]:
    """The names of shapes that Live Link Face's file would not give back: halves that it merges, and those it lacks."""
    return tuple(name for name in names if spelled_as(name, ARKIT) is None)


def load_live_link(path: str | Path) -> Take:
    """Reads a take recorded with Live Link Face.

    Names stay as the file spells and orders them (``EyeBlinkLeft``). The rate is deduced from the timecodes
    (:func:`torchface.io.tables.timecode.read_timecodes`). A row of no face (count 0) is NaN. ``extras`` holds

    - ``columns``: every other column by name: rotations in radians and numbers (T,) float64, text as a tuple;
    - ``blendshape_count``: the column of that name, one whole number a frame;
    - ``measured_fps``: what the clock says before it is rounded to a usual rate.

    Frames that were dropped are not filled: the others keep their times. Up to half of the shapes may be missing; they
    stand last and are 0, with a ``UserWarning``.

    Returns:
        weights (T,52,1), float32, which holds the app's ten decimals without loss; ``timecode``; ``extras``.

    Source: Epic Games, "Recording Face Animation on iOS Device", CSV of Live Link Face.
    """
    path = Path(path)
    reader = TableReader(path)
    spelling = {name.lower(): name for name in reader.header}
    missing = [name for name in ("Timecode", "BlendshapeCount", *ARKIT) if name.lower() not in spelling]
    lacking = [name[0].upper() + name[1:] for name in missing if name in ARKIT]
    if len(missing) > len(lacking) or len(lacking) > _MOST_LACKING:
        raise FileFormatError(
            f"{path}: found no column {quoted(missing)}, expected Timecode, BlendshapeCount and ARKit's 52 shapes"
        )
    if lacking:
        warnings.warn(f"{path}: found no column {quoted(lacking, 10)}: those weights are read as 0", stacklevel=3)
    if len(spelling) < len(reader.header) or "" in spelling:
        raise FileFormatError(
            f"{path}: found columns without a name, or whose names differ in case only; expected one each"
        )
    rotations = {name.lower() for name in ROTATIONS}
    texts = [name for key, name in spelling.items() if key not in _SHAPES and key not in rotations]
    count_column = reader.header.index(spelling[_COUNT])
    table = reader.read(texts, lambda cells: len(cells) > count_column and cells[count_column].strip() == "0")
    timing = read_timecodes(table.texts[spelling[_TIMECODE]], path)
    names = tuple(name for name in table.names if name.lower() in _SHAPES)
    columns: dict[str, Any] = {}
    for name in reader.header:
        if name in table.texts and name.lower() not in (_TIMECODE, _COUNT):
            columns[name] = _numbers_or_texts(table.texts[name])
        elif name.lower() in rotations:
            columns[name] = torch.from_numpy(table.column(name).copy())
    extras = {
        "columns": columns,
        "blendshape_count": _counts(table.texts[spelling[_COUNT]], path),
        "measured_fps": timing.measured,
    }
    values = table.columns(names, np.float32)
    unseen = np.isnan(values).all(1, keepdims=True)
    weights = torch.from_numpy(np.hstack([values, *[np.where(unseen, np.float32(np.nan), 0)] * len(lacking)]))[
        ..., None
    ]
    timecode = table.texts[spelling[_TIMECODE]]
    return Take(
        timing.fps, weights=Track((*names, *lacking), weights), timecode=timecode, extras=extras, seconds=timing.seconds
    )


def _numbers_or_texts(cells: tuple[str, ...]) -> torch.Tensor | tuple[str, ...]:
    numbers = [parse_number(cell) for cell in cells]
    if None in numbers or not any(cells):
        return cells
    return torch.tensor(numbers, dtype=torch.float64)


def _counts(cells: tuple[str, ...], path: Path) -> tuple[int, ...]:
    for row, cell in enumerate(cells):
        if not (cell.isascii() and cell.isdigit() and len(cell) <= 6):
            raise FileFormatError(
                f"{path}: frame {row + 1}, column 'BlendshapeCount': found {quoted([cell])}, expected a whole number"
            )
    return tuple(map(int, cells))


def save_live_link(take: Take, path: str | Path) -> None:
    """Writes the weights of a take as Live Link Face would have.

    A take that ``load_live_link`` read gives the same file again, byte by byte where it came from the app. Weights by
    other names go to ARKit's by :func:`torchface.shape_names.mapping`: halves of a split shape give their mean, a
    shape that the take lacks is 0, one that ARKit lacks is left out. Without timecodes of its own a take starts at
    00:00:00:00.000, or later by the number of its first frame; those it has are written as they are. Without rotations
    they are 0. ARKit's own spelling (``eyeBlinkLeft``) becomes the app's (``EyeBlinkLeft``).

    Args:
        take: weights (T,N,1); NaN becomes an empty cell.
        path: the file; it appears only when it is complete.

    Raises:
        ValueRangeError: the take has no weights, infinite ones, an absurd rate, or text that is no timecode.
        NameMismatchError: not one name is one of ARKit's.
        ShapeError: a kept column has another length than the take.

    Source: Epic Games, "Recording Face Animation on iOS Device", CSV of Live Link Face.

    Example:
        >>> from torchface import Track, load_take
        >>> save_live_link(Take(60.0, weights=Track(("jawOpen",), torch.full((3, 1, 1), 0.25))), "take.csv")
        >>> load_take("take.csv").weights.select(["JawOpen"]).values.flatten().tolist()
        [0.25, 0.25, 0.25]
    """
    path = Path(path)
    names, values = values_to_write(take.weights, "weights", 1, path)
    names, values = _as_arkit(names, values[..., 0], path)
    check_rate(take.fps, f"{path}: the take", ValueRangeError)
    timecodes = take.timecode
    if timecodes is None and take.seconds is not None:
        timecodes = timecodes_at(take.seconds.numpy())
    timecodes = timecodes or write_timecodes(len(take), take.fps, max(0, frame_numbers(take, first=0)[0]))
    try:
        read_timecodes(timecodes, path)
    except FileFormatError as error:
        raise ValueRangeError(str(error)) from error
    columns = kept_columns(take, path)
    if "columns" not in take.extras:
        columns = {name: torch.zeros(len(take), dtype=torch.float64) for name in ROTATIONS}
    counts = take.extras.get("blendshape_count")
    if counts is None:
        counts = [len(names) + sum(isinstance(column, torch.Tensor) for column in columns.values())] * len(take)
    if len(counts) != len(take):
        raise ShapeError(f"{path}: found {len(counts)} kept blendshape counts, expected {len(take)} frames")
    numbers = [column for column in columns.values() if isinstance(column, torch.Tensor)]
    angles = torch.stack(numbers, 1).detach().cpu().double().numpy() if numbers else np.zeros((len(take), 0))
    rows = (
        [timecode, str(count), *_ten_decimals(values[row]), *_in_order(columns, row, _ten_decimals(angles[row]))]
        for row, (timecode, count) in enumerate(zip(timecodes, counts, strict=True))
    )
    header = [name[0].upper() + name[1:] if name in ARKIT else name for name in names]
    write_table(path, ["Timecode", "BlendshapeCount", *header, *columns], rows)


def _in_order(columns: Mapping[str, Any], row: int, numbers: Sequence[str]) -> Iterator[str]:
    """One row's cells of columns of numbers, which are given, and of texts."""
    given = iter(numbers)
    for column in columns.values():
        yield next(given) if isinstance(column, torch.Tensor) else str(column[row])


def _as_arkit(names: tuple[str, ...], values: np.ndarray, path: Path) -> tuple[tuple[str, ...], np.ndarray]:
    if are_live_link_shapes(names):
        return names, values
    matrix = mapping(names, ARKIT).numpy()
    if not matrix.any():
        raise NameMismatchError(f"{path}: found the shapes {quoted(names)}, expected at least one of ARKit's")
    unseen = np.isnan(values)
    mapped = np.where(unseen, 0, values).astype(np.float64) @ matrix.T.astype(np.float64)
    mapped[(unseen.astype(np.float32) @ matrix.T) > 0] = np.nan
    return ARKIT, mapped.astype(np.float32)


def _ten_decimals(values: np.ndarray) -> list[str]:
    """Ten decimals as the app writes them, more where these do not give the number back; empty for NaN."""
    texts = [f"{value:.10f}" for value in values.tolist()]
    back = np.array([float(text) for text in texts]).astype(values.dtype)
    for i in np.flatnonzero(back != values):
        texts[i] = "" if np.isnan(values[i]) else str(values[i])
    return texts
