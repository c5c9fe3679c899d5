"""Comma-separated tables of numbers: every cell is checked, and a fault is named by row and column."""

import codecs
import csv
import io
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path

import numpy as np

from torchface.errors import FileFormatError, NameMismatchError
from torchface.escaped_text import listed
from torchface.files.whole_files import read_file, replaced_file

_SEVERAL_HEADERS = {"format version": "OptiTrack Motive's", "trajectories": "Vicon's"}  # by their first cell
MAX_TABLE_BYTES = 2**29  # bytes of text; two hours of 60 fps Live Link Face stay below

_MAX_ROW = 2**22
_MAX_NUMBER = float(np.finfo(np.float32).max)
_SHARED_TEXT = 3  # letters; there are few texts so short, and a table may hold each a million times
_BLOCK = 2**20
_SEPARATOR = re.compile(r"sep=([,;\t])\s*", re.IGNORECASE)
_QUOTED = re.compile(r'"[^"]*"')
_FORMULA = re.compile(r"'*[=+\-@]")
_RUN = ("=", "@", "'")  # a number may begin with a sign


@dataclass(frozen=True)
class Table:
    """Rows of a file: ``numbers`` (T,C) float64 by ``names`` (NaN where a cell is empty), ``texts`` by column name."""

    names: tuple[str, ...]
    numbers: np.ndarray
    texts: dict[str, tuple[str, ...]]

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    def column(self, name: str) -> np.ndarray:
        return self.numbers[:, self._index[name]]

    def columns(self, names: Sequence[str], dtype: type[np.floating] = np.float64) -> np.ndarray:
        """Some columns (T,C) in this order."""
        wanted = [self._index[name] for name in names]
        numbers = np.empty((len(self.numbers), len(wanted)), dtype)
        rows = 1 + _BLOCK // max(1, len(wanted))
        for first in range(0, len(numbers), rows):  # so that no second copy of a long take is made
            numbers[first : first + rows] = self.numbers[first : first + rows, wanted]
        return numbers


class CellRows:
    """The rows of a file, as they are asked for; ``number`` is that of the last one's line.

    Commas stand between cells; or semicolons, as where numbers have decimal commas; or what Excel's line before the
    first row, such as ``sep=;``, says.
    """

    def __init__(self, path: str | Path, most_bytes: int = MAX_TABLE_BYTES) -> None:
        self._lines = TextLines(Path(path), read_file(path, most_bytes))
        first, before = next(self._lines, ""), list[str]()
        if stated := _SEPARATOR.fullmatch(first):
            before, first = ["\n"], next(self._lines, "")
        unquoted = _QUOTED.sub("", first)
        self.separator = stated[1] if stated else ";" if ";" in unquoted and "," not in unquoted else ","
        self._rows = csv.reader(chain(before, [first], self._lines), delimiter=self.separator)
        if before:
            next(self)

    @property
    def number(self) -> int:
        return self._rows.line_num

    def __iter__(self) -> Iterator[list[str]]:
        return self

    def __next__(self) -> list[str]:
        self._lines.row_begins()
        try:
            return next(self._rows)
        except csv.Error as error:
            raise FileFormatError(f"{self._lines.path}: row {self.number}: {error}; expected a table") from error


class TableReader:
    """A file whose first row, the header, is read, and whose other rows are read once their columns are known.

    Decimal commas are read where no commas stand between cells. Rows may all end in empty cells that have no name.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._rows = CellRows(path)
        header = [_unescaped(cell.strip()) for cell in next(self._rows, ())]
        while header and not header[-1]:
            header.pop()
        self.header = tuple(header)
        if not any(self.header):
            raise FileFormatError(f"{path}: found no header, expected the names of the columns in the first row")
        program = _SEVERAL_HEADERS.get(self.header[0].lower())
        if program is not None:
            raise FileFormatError(
                f"{path}: found {program} table with several rows of headers, expected one: export markers as C3D or "
                "TRC"
            )
        twice = [name for name, count in Counter(self.header).items() if count > 1]
        if twice:
            raise FileFormatError(f"{path}: found more than one column {quoted(twice)}, expected each once")

    def require(self, names: Iterable[str]) -> None:
        """Raises ``FileFormatError`` where the header lacks one of these columns."""
        has = set(self.header)
        missing = [name for name in names if name not in has]
        if missing:
            raise FileFormatError(f"{self.path}: found no column {quoted(missing)}, expected it in the header")

    def read(
        self,
        texts: Iterable[str] = (),
        is_blank: Callable[[list[str]], bool] = lambda cells: False,
        only: Iterable[str] | None = None,
    ) -> Table:
        """All rows; the columns ``texts`` are kept as they stand, and of numbers those ``only``, or all, are read.

        A row that ``is_blank`` may be short of cells; the missing ones count as empty.
        """
        width = len(self.header)
        text_cells: dict[str, list[str]] = {name: [] for name in texts}
        shared: dict[str, str] = {}
        text_columns = [i for i, name in enumerate(self.header) if name in text_cells]
        numeric = set(self.header if only is None else only) - set(text_cells)
        number_columns = [i for i, name in enumerate(self.header) if name in numeric]
        names = tuple(self.header[i] for i in number_columns)
        numbers, rows = array("d"), 0
        for cells in self._rows:
            if not cells:
                continue
            if len(cells) > width and not any(cell.strip() for cell in cells[width:]):
                del cells[width:]
            if len(cells) < width and is_blank(cells):
                cells += [""] * (width - len(cells))
            if len(cells) != width:
                raise FileFormatError(
                    f"{self.path}: row {self._rows.number}: found {len(cells)} cells, expected {width}"
                )
            for i in text_columns:
                text = _unescaped(cells[i].strip())
                text_cells[self.header[i]].append(text if len(text) > _SHARED_TEXT else shared.setdefault(text, text))
            wanted = [cells[i] if self._rows.separator == "," else cells[i].replace(",", ".") for i in number_columns]
            numbers.extend(parse_numbers(wanted, names, f"{self.path}: row {self._rows.number}"))
            rows += 1
        if rows == 0:
            raise FileFormatError(f"{self.path}: found a header and no rows, expected at least one frame")
        return Table(
            names,
            np.frombuffer(numbers, np.float64).reshape(rows, len(number_columns)),
            {name: tuple(text_cells.pop(name)) for name in list(text_cells)},
        )


class TextLines:
    """The lines of a file in UTF-8, or UTF-16 that says so, with their ends, decoded as they are asked for."""

    def __init__(self, path: Path, data: bytes, newline: str = "") -> None:
        self.path = path
        self._kind = "UTF-16" if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "UTF-8"
        encoding = "utf-8-sig" if self._kind == "UTF-8" else self._kind
        self._file = io.TextIOWrapper(io.BytesIO(data), encoding, newline=newline)
        self._row_size = 0

    def row_begins(self) -> None:
        """Of one row, which may be of several lines, only so much is read."""
        self._row_size = 0

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        try:
            line = self._file.readline(_MAX_ROW + 1)
        except UnicodeDecodeError as error:
            raise FileFormatError(
                f"{self.path}: found bytes that are no {self._kind} ({error.reason}), expected a table"
            ) from error
        self._row_size += len(line)
        if self._row_size > _MAX_ROW:
            raise FileFormatError(f"{self.path}: found a row of more than {_MAX_ROW} letters, expected a table")
        if not line:
            raise StopIteration
        return line


def parse_numbers(cells: Sequence[str], names: Sequence[str], where: str) -> list[float]:
    """A row's numbers, NaN where a cell is empty; messages name file, row and column."""
    joined = "".join(cells)
    if joined.isascii() and "_" not in joined:  # Python would take 1_000 and other scripts' digits for numbers
        try:
            values = list(map(float, cells))
            if all(-_MAX_NUMBER <= value <= _MAX_NUMBER or value != value for value in values):
                return values
        except ValueError:
            pass
    numbers = []
    for name, cell in zip(names, cells, strict=True):
        value = parse_number(cell)
        if value is None:
            raise FileFormatError(f"{where}, column {quoted([name])}: found {quoted([cell])}, expected a number")
        numbers.append(value)
    return numbers


def parse_number(cell: str) -> float | None:
    """A finite number, NaN where the cell is empty or says so, None where it is none."""
    if not cell.strip():
        return float("nan")
    try:
        value = float(cell) if cell.isascii() and "_" not in cell else None
    except ValueError:
        return None
    if value is None or abs(value) > _MAX_NUMBER:
        return None
    return value


def quoted(names: Sequence[str], limit: int = 5) -> str:
    """The first few, short enough for a message."""
    return listed((repr(name if len(name) <= 40 else name[:37] + "...") for name in names), limit)


def _escaped(name: str) -> str:
    """A cell that no spreadsheet takes for a formula to run."""
    return f"'{name}" if _FORMULA.match(name) else name


def _unescaped(cell: str) -> str:
    return cell[1:] if cell[:1] == "'" and _FORMULA.match(cell) else cell


def write_table(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Writes what ``TableReader`` reads, row by row; the file appears only when it is complete.

    Names in the header, and cells that begin with ``=`` or ``@``, which a spreadsheet would run, get an apostrophe
    before them, which ``TableReader`` takes away.
    """
    try:
        with replaced_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as text:
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(map(_escaped, header))
            writer.writerows([_escaped(cell) if cell[:1] in _RUN else cell for cell in row] for row in rows)
    except UnicodeEncodeError as error:
        raise NameMismatchError(f"{path}: found a name that is no valid Unicode ({error.reason})") from error


def number_texts(values: np.ndarray) -> list[str]:
    """The shortest digits that give each number of a flat array back; empty for NaN."""
    texts = [str(value) for value in values] if values.dtype == np.float32 else [repr(v) for v in values.tolist()]
    return ["" if text == "nan" else text for text in texts]
