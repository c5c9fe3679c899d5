"""The tables of a PLY file, ASCII or binary: a header that lists elements, then rows, some with lists in them."""

import struct
from array import array
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchface.errors import FileFormatError
from torchface.files.line_pieces import word_pieces

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_MAX_HEADER = 2**16
_ROWS = 2**16


@dataclass
class Element:
    """A table of the file; a property is (name, numpy type, type of its count where it is a list)."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)


@dataclass(frozen=True)
class Lists:
    """Rows of different lengths: ``sizes`` (P,) and all ``values`` in a line (C,)."""

    sizes: NDArray[np.int64]
    values: NDArray[Any]


def read_tables(path: Path, data: bytes, wanted: Collection[str]) -> tuple[dict[str, dict[str, Any]], list[Element]]:
    """Columns by name of the wanted elements, arrays (P,) or ``Lists``, and all elements as the header names them."""
    elements, order, start = _header(path, data)
    # A unit of the body is a byte where it is binary, a number where it is text.
    body = _words(path, data[start:]) if order == "" else np.frombuffer(data, np.uint8, offset=start)
    tables: dict[str, dict[str, Any]] = {}
    at = 0
    for element in elements:
        if element.name in wanted:
            tables[element.name], at = _columns(path, element, order, body, at) if element.count else ({}, at)
        else:
            at = _end(path, element, order, body, at)
    return tables, elements


def _header(path: Path, data: bytes) -> tuple[list[Element], str, int]:
    end = data.find(b"end_header", 0, _MAX_HEADER)
    if data[:3] != b"ply" or end < 0:
        raise FileFormatError(f"{path}: found no PLY header, expected 'ply' ... 'end_header'")
    newline = data.find(b"\n", end)
    elements: list[Element] = []
    order = None
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if len(words) >= 2 and words[0] == "format":
            order = _ORDERS.get(words[1])
        elif len(words) == 3 and words[0] == "element" and words[2].isdecimal() and len(words[2]) < 16:
            elements.append(Element(words[1], int(words[2])))
        elif len(words) == 3 and words[0] == "property" and elements and words[1] in _TYPES:
            elements[-1].properties.append((words[2], _TYPES[words[1]], None))
        elif len(words) == 5 and words[:2] == ["property", "list"] and elements and set(words[2:4]) <= set(_TYPES):
            elements[-1].properties.append((words[4], _TYPES[words[3]], _TYPES[words[2]]))
        elif words and words[0] not in ("comment", "obj_info"):
            raise FileFormatError(f"{path}: found the header line '{line[:60]}', expected an element or a property")
    if order is None or newline < 0:
        raise FileFormatError(f"{path}: found no format that is known, expected one of {', '.join(_ORDERS)}")
    for element in elements:
        names = [name for name, _, _ in element.properties]
        if len(set(names)) != len(names) or not names:
            raise FileFormatError(
                f"{path}: found properties {names[:6]} in element {element.name!r}, expected some, each once"
            )
    return elements, order, newline + 1


def _words(path: Path, body: bytes) -> NDArray[np.float64]:
    try:
        pieces = [np.array(list(map(float, words)), dtype=np.float64) for words in word_pieces(path, body)]
    except ValueError as error:
        raise FileFormatError(f"{path}: found text among the numbers ({error})") from error
    return np.concatenate(pieces) if pieces else np.zeros(0)


def _columns(path: Path, element: Element, order: str, body: NDArray[Any], at: int) -> tuple[dict[str, Any], int]:
    """The columns of an element that begins at unit ``at``, and where the next one begins."""
    spans = _spans(path, element, order, body, at, 1)
    row = int(spans[0, -1].sum()) - at
    if row * element.count <= len(body) - at:
        columns = _equal_rows(element, order, body[at : at + row * element.count].reshape(-1, row), spans[0] - [at, 0])
        if columns is not None:
            return columns, at + row * element.count
    elif all(count is None for _, _, count in element.properties):
        raise _truncated(path, element, len(body) - at, str(row * element.count))
    spans = _spans(path, element, order, body, at, element.count)
    columns = {}
    for (name, kind, count), (starts, units) in zip(element.properties, spans.transpose(1, 2, 0), strict=True):
        units_of = np.repeat(starts - (np.cumsum(units) - units), units) + np.arange(int(units.sum()))
        values = _decode(body[units_of], order, kind)
        columns[name] = values if count is None else Lists(units // _width(order, kind), values)
    return columns, int(spans[-1, -1].sum())


def _end(path: Path, element: Element, order: str, body: NDArray[Any], at: int) -> int:
    """Where the element behind one that nobody reads begins."""
    if all(count is None for _, _, count in element.properties):
        size = element.count * sum(_width(order, kind) for _, kind, _ in element.properties)
        if size > len(body) - at:
            raise _truncated(path, element, len(body) - at, str(size))
        return at + size
    for first in range(0, element.count, _ROWS):
        spans = _spans(path, element, order, body, at, min(_ROWS, element.count - first))
        at = int(spans[-1, -1].sum())
    return at


def _equal_rows(element: Element, order: str, rows: NDArray[Any], spans: NDArray[np.int64]) -> dict[str, Any] | None:
    """The columns of rows (P,R) whose lists all have the lengths of the first row's; none where they do not."""
    columns: dict[str, Any] = {}
    for (name, kind, count), (start, units) in zip(element.properties, spans.tolist(), strict=True):
        values = _decode(rows[:, start : start + units], order, kind).reshape(-1)
        if count is None:
            columns[name] = values
            continue
        size = units // _width(order, kind)
        if (_decode(rows[:, start - _width(order, count) : start], order, count) != size).any():
            return None
        columns[name] = Lists(np.full(len(rows), size), values)
    return columns


def _spans(path: Path, element: Element, order: str, body: NDArray[Any], at: int, rows: int) -> NDArray[np.int64]:
    """First unit and number of units of every property in the first rows, (rows, properties, 2)."""
    if rows > len(body) - at:
        raise _truncated(path, element, len(body) - at, f"at least {element.count}")
    if any(count is not None and order and np.dtype(count).kind == "f" for _, _, count in element.properties):
        raise _truncated(path, element, len(body) - at, "an integer that gives a list's length")
    plan = [
        (_width(order, kind), None if count is None else _length_reader(order, count), _width(order, count or kind))
        for _, kind, count in element.properties
    ]
    units = body.data  # quicker one by one
    spans = array("q")
    end = len(body)
    for _ in range(rows):  # where a row begins is known only after the one before
        for width, read_length, before in plan:
            length = 1
            if read_length is not None:
                length = read_length(units, at) if at + before <= end else -1
                at += before
            if not 0 <= length * width <= end - at:
                raise _truncated(path, element, max(end - at, 0), f"a list of {length}")
            spans.append(at)
            spans.append(length * width)
            at += length * width
    return np.frombuffer(spans, np.int64).reshape(rows, -1, 2)


def _length_reader(order: str, kind: str) -> Callable[[Any, int], int]:
    """Reads the length of a list at a unit; -1 for none that can be."""
    if order:
        unpack = struct.Struct(order + np.dtype(kind).char).unpack_from
        return lambda units, at: unpack(units, at)[0]
    return lambda units, at: int(units[at]) if float(units[at]).is_integer() else -1


def _width(order: str, kind: str) -> int:
    return np.dtype(kind).itemsize if order else 1


def _decode(units: NDArray[Any], order: str, kind: str) -> NDArray[Any]:
    return np.ascontiguousarray(units).view(order + kind) if order else units


def _truncated(path: Path, element: Element, left: int, wanted: str) -> FileFormatError:
    return FileFormatError(
        f"{path}: found {left} bytes or words (truncated) for {element.count} rows of {element.name!r}, "
        f"expected {wanted}"
    )
