"""Settings of recipes as TOML: nested ones are tables, paths are texts, what is absent is left out."""

from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro

from torchface.files.documents import Value, read_toml, write_toml

_LARGEST = 2**62
_ABSENT = "none"  # TOML has no word for it; written where something else is the default
Settings = TypeVar("Settings")


def write_settings(path: Path, settings: Any) -> None:
    """Writes the effective settings: :func:`read_settings` reads the same ones."""
    write_toml(path, _plain(settings))


def read_settings(path: Path, kind: type[Settings]) -> Settings:
    """Settings of a file; what it does not name is as by default, and as not given where there is no default."""
    return _table(read_toml(path), kind)


def _table(given: Value, kind: type[Settings]) -> Settings:
    own = fields(kind)  # type: ignore[arg-type]
    hints = get_type_hints(kind)
    values = {
        name: _value(value, hints[name])
        for name, value in given.table(*(one.name for one in own), expected=f"a table of {kind.__name__}").items()
    }
    missing = {one.name: tyro.MISSING for one in own if one.name not in values and _required(one)}
    return kind(**values, **missing)


def _required(field: Field[Any]) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _value(given: Value, hint: Any) -> Any:
    """A value of the kind that a field's annotation asks for."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if given.found == _ABSENT and NoneType in inner:
            return None
        (hint,) = (one for one in inner if one is not NoneType)
        return _value(given, hint)
    if origin is Literal:
        if given.found not in inner:
            raise given.error("one of " + ", ".join(map(repr, inner)))
        return given.found
    if origin is tuple:
        if inner[1:] == (...,):
            return tuple(_value(row, inner[0]) for row in given.rows())
        rows = given.rows(len(inner), len(inner), f"a list of {len(inner)}")
        return tuple(_value(row, one) for row, one in zip(rows, inner, strict=True))
    if hint is bool:
        if not isinstance(given.found, bool):
            raise given.error("true or false")
        return given.found
    if hint is int:
        return given.whole(-_LARGEST, _LARGEST, "a whole number")
    if hint is float:
        return given.number("a number")
    if hint in (str, Path):
        expected = "a path" if hint is Path else "text"
        if "\0" in given.text(expected):
            raise given.error(f"{expected} without NUL")
        return hint(given.found)
    return _table(given, hint)


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {own.name: _given(getattr(value, own.name), own) for own in fields(value)}
    if isinstance(value, tuple):
        return [_plain(inner) for inner in value]
    return str(value) if isinstance(value, Path) else value


def _given(value: Any, field: Field[Any]) -> Any:
    return _ABSENT if value is None and field.default is not None else _plain(value)
