"""The tables of a PLY file, ASCII or binary: a header that lists elements, then rows, some with lists in them."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchface.errors import FileFormatError

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
_LARGEST_HEADER = 2**16


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
    values: NDArray[np.float64]


def read_tables(path: Path, data: bytes) -> tuple[dict[str, dict[str, Any]], list[Element]]:
    """Every element's columns by name, arrays (P,) or ``Lists``, and the elements as the header tells them.

    Of an element with lists the other columns are left out.

    Raises:
        FileFormatError: no PLY, another format, truncated, or text among the numbers.
    """
    elements, order, start = _header(path, data)
    return (
        _ascii(path, elements, data[start:]) if order == "" else _binary(path, elements, order, data, start)
    ), elements


def _header(path: Path, data: bytes) -> tuple[list[Element], str, int]:
    end = data.find(b"end_header", 0, _LARGEST_HEADER)
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


def _truncated(path: Path, element: Element, found: int, wanted: str) -> FileFormatError:
    return FileFormatError(
        f"{path}: found {found} bytes or words (truncated) for {element.count} rows of {element.name!r}, "
        f"expected {wanted}"
    )


def _binary(path: Path, elements: list[Element], order: str, data: bytes, at: int) -> dict[str, dict[str, Any]]:
    tables: dict[str, dict[str, Any]] = {}
    for element in elements:
        if any(count is not None for _, _, count in element.properties):
            tables[element.name], at = _binary_lists(path, element, order, data, at)
            continue
        dtype = np.dtype([(name, order + kind) for name, kind, _ in element.properties])
        size = dtype.itemsize * element.count
        if size > len(data) - at:
            raise _truncated(path, element, len(data) - at, str(size))
        rows = np.frombuffer(data, dtype, element.count, at)
        tables[element.name] = {name: rows[name].astype(np.float64) for name in dtype.names or ()}
        at += size
    return tables


def _binary_lists(path: Path, element: Element, order: str, data: bytes, at: int) -> tuple[dict[str, Any], int]:
    """Rows with lists: at once where all have the first row's lengths, else row by row."""
    if element.count == 0:
        return {}, at
    fields: list[tuple[str, str, int]] = []
    offset = at
    for name, kind, count in element.properties:
        length = 1
        if count is not None:
            length = _number(path, element, data, offset, order + count)
            fields.append((f"count {name}", order + count, 1))
            offset += np.dtype(count).itemsize
        if not 0 <= length * np.dtype(kind).itemsize <= len(data) - offset:
            raise _truncated(path, element, len(data) - offset, f"a list of {length}")
        fields.append((name, order + kind, length))
        offset += length * np.dtype(kind).itemsize
    dtype = np.dtype([(name, kind, (length,)) for name, kind, length in fields])
    if dtype.itemsize * element.count <= len(data) - at:
        rows = np.frombuffer(data, dtype, element.count, at)
        lengths = {name: length for name, _, length in fields}
        if all((rows[name] == lengths[name[6:]]).all() for name in lengths if name.startswith("count ")):
            lists = {
                name: Lists(np.full(element.count, lengths[name]), rows[name].reshape(-1).astype(np.float64))
                for name, _, count in element.properties
                if count is not None
            }
            return lists, at + dtype.itemsize * element.count
    return _binary_rows(path, element, order, data, at)


def _binary_rows(path: Path, element: Element, order: str, data: bytes, at: int) -> tuple[dict[str, Any], int]:
    """Where each row begins is known only after the one before: hence the loop."""
    if element.count > len(data) - at:
        raise _truncated(path, element, len(data) - at, f"at least {element.count}")
    sizes: dict[str, list[int]] = {name: [] for name, _, _ in element.properties}
    pieces: dict[str, list[bytes]] = {name: [] for name, _, _ in element.properties}
    plan = [
        (name, np.dtype(kind).itemsize, None if count is None else struct.Struct((order or "<") + _CODES[count]))
        for name, kind, count in element.properties
    ]
    for _ in range(element.count):
        for name, width, counter in plan:
            length = 1
            if counter is not None:
                if at + counter.size > len(data):
                    raise _truncated(path, element, len(data), "more")
                length = int(counter.unpack_from(data, at)[0]) if counter.size else 0
                at += counter.size
            end = at + length * width
            if length < 0 or end > len(data):
                raise _truncated(path, element, len(data) - at, f"a list of {length}")
            sizes[name].append(length)
            pieces[name].append(data[at:end])
            at = end
    lists = {
        name: Lists(np.array(sizes[name]), np.frombuffer(b"".join(pieces[name]), order + kind).astype(np.float64))
        for name, kind, count in element.properties
        if count is not None
    }
    return lists, at


_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "x", "f8": "x"}
"""For ``struct``; a count that is no integer is refused before."""


def _number(path: Path, element: Element, data: bytes, at: int, kind: str) -> int:
    dtype = np.dtype(kind)
    if dtype.kind == "f" or at + dtype.itemsize > len(data):
        raise _truncated(path, element, max(len(data) - at, 0), "an integer that tells a list's length")
    return int(np.frombuffer(data, dtype, 1, at)[0])


def _ascii(path: Path, elements: list[Element], body: bytes) -> dict[str, dict[str, Any]]:
    try:
        words = np.array(list(map(float, body.split())), dtype=np.float64)
    except ValueError as error:
        raise FileFormatError(f"{path}: found text among the numbers ({error})") from error
    tables: dict[str, dict[str, Any]] = {}
    at = 0
    for element in elements:
        width = len(element.properties)
        if element.count * width > len(words) - at:
            raise _truncated(path, element, len(words) - at, f"at least {element.count * width}")
        if all(count is None for _, _, count in element.properties):
            rows = words[at : at + element.count * width].reshape(element.count, width)
            tables[element.name] = {name: rows[:, i] for i, (name, _, _) in enumerate(element.properties)}
            at += element.count * width
        else:
            tables[element.name], at = _ascii_rows(path, element, words, at)
    return tables


def _ascii_rows(path: Path, element: Element, words: NDArray[np.float64], at: int) -> tuple[dict[str, Any], int]:
    """Where each row begins is known only after the one before: hence the loop."""
    sizes: dict[str, list[int]] = {name: [] for name, _, count in element.properties if count is not None}
    pieces: dict[str, list[NDArray[np.float64]]] = {name: [] for name in sizes}
    for _ in range(element.count):
        for name, _, count in element.properties:
            if count is None:
                at += 1
                continue
            length = float(words[at]) if at < len(words) else -1.0
            if not (length >= 0 and length.is_integer() and at + 1 + length <= len(words)):
                raise _truncated(path, element, max(len(words) - at, 0), f"a list of {length:g}")
            end = at + 1 + int(length)
            sizes[name].append(int(length))
            pieces[name].append(words[at + 1 : end])
            at = end
    return {
        name: Lists(np.array(sizes[name], np.int64), np.concatenate(pieces[name]) if pieces[name] else words[:0])
        for name in sizes
    }, at
