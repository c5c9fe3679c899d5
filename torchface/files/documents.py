"""Small documents, JSON and TOML: read with a limit, their values checked one by one, written whole."""

import json
import re
import reprlib
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import torch
from torch import Tensor

from torchface.errors import ArgumentTypeError, FileFormatError
from torchface.files.whole_files import read_file, write_file

_MAX_BYTES = 2**20
_MAX_TOML_BYTES = 2**18  # its parser takes up to 500 bytes for one of the text
_MAX_NUMBER = 1e9  # absolute; nothing that these files measure is larger
_MAX_WHOLE = 2**63
_MAX_DEPTH, _MAX_CONTAINERS = 64, 2**20
_MAX_DOTS = 16  # in a key: TOML's parser takes time and memory by the square of them

_ESCAPE = re.compile(rb"\\.", re.DOTALL)
_BRACKETS = (b"[", b"]", b"{", b"}")
_LONG_WHOLE_NUMBER = re.compile(rb"(?<![\d.eE+-])-?(\d{19,})(?![\d.eE])")
_DOTTED_KEY = re.compile(
    rf"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{_MAX_DOTS + 1}}}""", re.ASCII
)

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 120
_SHORT.maxlist = _SHORT.maxdict = 40


@dataclass(frozen=True)
class Value:
    """A value of a document, and where it is from: read as the type asked for, or an error says where it is."""

    source: str | Path  # the file's name, or what else the document is
    key: str  # the path of keys that leads to it; empty for the document itself
    found: Any = None  # the value; None where there is none

    def error(self, expected: str) -> FileFormatError:
        """The error that names source, key, what was found and what was expected."""
        at = f"{self.key} = " if self.key else ""
        return FileFormatError(f"{self.source}: found {at}{_SHORT.repr(self.found):.120}, expected {expected}")

    def __bool__(self) -> bool:
        """Whether there is a value."""
        return self.found is not None

    def __getitem__(self, name: str) -> "Value":
        """A value of this table; an absent one is found as None."""
        if not isinstance(self.found, Mapping):
            raise self.error("a table")
        return Value(self.source, f"{self.key}.{name}" if self.key else name, self.found.get(name))

    def table(self, *names: str, expected: str = "a table") -> "dict[str, Value]":
        """The values of a table by name; with ``names`` it must have no others."""
        if not isinstance(self.found, Mapping) or not all(isinstance(name, str) for name in self.found):
            raise self.error(expected)
        unknown = sorted(set(self.found) - set(names)) if names else []
        if unknown:
            raise self[unknown[0]].error(f"only {', '.join(names)}")
        return {name: self[name] for name in self.found}

    def plain_table(self) -> dict[str, Any]:
        """A table as it is, its values unchecked."""
        self.table()
        return dict(self.found)

    def rows(self, minimum: int = 0, maximum: float = inf, expected: str = "a list") -> "list[Value]":
        """The values of a list."""
        if not isinstance(self.found, list) or not minimum <= len(self.found) <= maximum:
            raise self.error(expected)
        return [Value(self.source, f"{self.key}[{i}]", value) for i, value in enumerate(self.found)]

    def text(self, expected: str = "text") -> str:
        """A text."""
        if not isinstance(self.found, str):
            raise self.error(expected)
        return self.found

    def texts(self, expected: str = "a list of texts") -> tuple[str, ...]:
        """A list of texts."""
        if not isinstance(self.found, list) or not all(isinstance(text, str) for text in self.found):
            raise self.error(expected)
        return tuple(self.found)

    def whole(self, minimum: int = 0, maximum: int = 2**31 - 1, expected: str = "") -> int:
        """A whole number in a range, its ends included."""
        if type(self.found) is not int or not minimum <= self.found <= maximum:
            raise self.error(expected or f"a whole number from {minimum} to {maximum}")
        return self.found

    def number(self, expected: str = "a finite number", max_size: float = _MAX_NUMBER) -> float:
        """A number whose absolute value is below ``max_size``."""
        if type(self.found) not in (int, float) or not abs(self.found) < max_size:
            raise self.error(expected)
        return float(self.found)

    def tensor(self, *shape: int | None, dtype: torch.dtype = torch.float64, expected: str = "") -> Tensor:
        """Nested lists of finite numbers as a tensor; whole numbers from 0 where ``dtype`` is an integer's.

        Args:
            shape: the size of each axis, None where any will do.
            expected: for the error; the shape if absent.
        """
        whole = not dtype.is_floating_point
        sizes_text = ",".join("N" if size is None else str(size) for size in shape)
        error = expected or f"{'whole' if whole else 'finite'} numbers ({sizes_text})"
        values, sizes = [self.found], []
        for size in shape:
            if not all(isinstance(row, list) for row in values):
                raise self.error(error)
            sizes.append(len(values[0]) if size is None and values else size or 0)
            if any(len(row) != sizes[-1] for row in values):
                raise self.error(error)
            values = [value for row in values for value in row]
        if whole and not all(type(value) is int and 0 <= value < 2**31 for value in values):
            raise self.error(error)
        if not whole and not all(type(value) in (int, float) and abs(value) < _MAX_NUMBER for value in values):
            raise self.error(error)
        return torch.tensor(values, dtype=dtype, device="cpu").reshape(sizes)


def read_json(path: str | Path, marker: str | None = None, max_bytes: int = _MAX_BYTES) -> Value:
    """The document of a JSON file.

    Args:
        marker: what its field ``format`` must be.
        max_bytes: a larger file is refused.
    """
    return _read(path, parse_json, "JSON", marker, max_bytes)


def read_toml(path: str | Path, marker: str | None = None, max_bytes: int = _MAX_TOML_BYTES) -> Value:
    """The document of a TOML file; see :func:`read_json`."""
    return _read(path, _parse_toml, "TOML", marker, max_bytes)


def parse_json(data: bytes) -> Any:
    """The value that JSON text in UTF-8 stands for, its nesting and its numbers checked before it is built."""
    if b"\0" in data:
        raise ValueError("found a byte 0, expected text")
    plain = _ESCAPE.sub(b"", data) if b"\\" in data else data
    if sum(map(plain.count, _BRACKETS)) > 4 * _MAX_CONTAINERS:
        raise ValueError(
            f"more than {4 * _MAX_CONTAINERS} brackets, expected at most {_MAX_CONTAINERS} lists and tables"
        )
    letters = np.frombuffer(plain, np.uint8)
    quotes = np.flatnonzero(letters == ord('"'))
    folded = letters | 0x20  # one letter for both opening brackets, one for both closing ones
    places = np.flatnonzero((folded == ord("{")) | (folded == ord("}")))
    places = places[np.searchsorted(quotes, places) % 2 == 0]  # those in texts are behind an odd number of quotes
    opening = folded[places] == ord("{")
    if np.count_nonzero(opening) > _MAX_CONTAINERS:
        raise ValueError(f"{np.count_nonzero(opening)} lists and tables, expected at most {_MAX_CONTAINERS}")
    depth = int(np.where(opening, 1, -1).cumsum().max(initial=0))
    if depth > _MAX_DEPTH:
        raise ValueError(f"nested {depth} deep, expected at most {_MAX_DEPTH}")
    for match in _LONG_WHOLE_NUMBER.finditer(plain):
        too_long = len(match[1]) > 19 or int(match[1]) >= _MAX_WHOLE
        if too_long and np.searchsorted(quotes, match.start()) % 2 == 0:
            raise ValueError(f"a whole number of {len(match[1])} digits, expected at most 64 bits")
    return json.loads(data.decode("utf-8-sig"))


def _parse_toml(data: bytes) -> Any:
    text = data.decode()
    if _DOTTED_KEY.search(text):
        raise ValueError(f"a key of more than {_MAX_DOTS + 1} parts")
    document = tomllib.loads(text)
    pending: list[Any] = [document]
    while pending:  # not by recursion: it may be nested deep
        value = pending.pop()
        if type(value) is int and abs(value) >= _MAX_WHOLE:
            raise ValueError("a whole number of more than 64 bits")
        if isinstance(value, dict | list):
            pending.extend(value.values() if isinstance(value, dict) else value)
    return document


def write_json(path: str | Path, document: Mapping[str, Any], indent: int | None = 1) -> None:
    """Writes a JSON file that appears only when it is complete; JSON has no NaN nor infinity: they become null."""
    write_file(path, json.dumps(_without_nan(document), indent=indent, allow_nan=False).encode())


def write_toml(path: str | Path, document: Mapping[str, Any]) -> None:
    """Writes a TOML file that appears only when it is complete; what is None is left out, paths become texts."""
    try:
        text = tomli_w.dumps(_without_none(document))
    except TypeError as error:
        raise ArgumentTypeError(f"{path}: found what TOML cannot hold ({error}), expected texts and numbers") from error
    write_file(path, text.encode())


def _read(path: str | Path, parse: Callable[[bytes], Any], kind: str, marker: str | None, max_bytes: int) -> Value:
    data = read_file(path, max_bytes)
    try:
        document = Value(path, "", parse(data))
    except (ValueError, RecursionError) as error:  # what decoding and both parsers raise
        raise FileFormatError(f"{path}: not {kind} ({str(error)[:120]})") from error
    if marker is not None:
        format_name = document.found.get("format") if isinstance(document.found, Mapping) else None
        if format_name != marker:
            raise FileFormatError(f'{path}: found format {_SHORT.repr(format_name):.60}, expected "{marker}"')
    return document


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_none(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list | tuple):
        return [_without_none(inner) for inner in value]
    return str(value) if isinstance(value, Path) else value


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nan(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(inner) for inner in value]
    return None if isinstance(value, float) and not isfinite(value) else value
