"""Inputs of a command, which none of its outputs may replace: compared as files, through links and spellings."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from torchface.errors import FileFormatError

Identity = tuple[int, int]  # of a file on this machine: its device and number, which links and spellings share


@dataclass(frozen=True)
class _Inputs:
    names: dict[Identity, Path]
    folders: tuple[Path, ...]
    own: tuple[Path, ...]


_kept: ContextVar[_Inputs | None] = ContextVar("kept", default=None)


@contextmanager
def kept_inputs(inputs: Iterable[Path], outputs: Iterable[tuple[str, Path]]) -> Iterator[None]:
    """Refuses outputs that are inputs, before the block, and inside it all that would be written over an input.

    Args:
        inputs: files and folders; what is not there is left out. Of a folder those files are kept that are read.
        outputs: of options by name, files and folders; and names of files in such folders.
    """
    outer = _kept.get() or _Inputs({}, (), ())
    names: dict[Identity, Path] = {}
    for path in inputs:
        if (identity := _identity(path)) is not None:
            names.setdefault(identity, path)
    outputs = [(option, path) for option, path in outputs]
    seen: dict[Path, str] = {}
    for option, path in outputs:
        if (source := names.get(_identity(path))) is not None:  # type: ignore[arg-type]
            raise _refused(f"{option}: found {path}", source)
        place = path.resolve()
        if (other := seen.setdefault(place, option)) != option:
            raise FileFormatError(f"{option}: found {path}, which {other} names too, expected another name for each")
    own = (*outer.own, *(path for path in seen if path.is_dir()))
    folders = (*outer.folders, *(path.resolve() for path in names.values() if path.is_dir()))
    token = _kept.set(_Inputs(outer.names | names, folders, own))
    try:
        yield
    finally:
        _kept.reset(token)


def note_read(path: Path) -> None:
    """Keeps a file of an input folder from now on; what a command itself wrote into its output folder is none."""
    kept = _kept.get()
    if kept is None or not kept.folders:
        return
    place = path.resolve()
    above = set(place.parents)
    if above & set(kept.folders) and not above & set(kept.own) and (identity := _identity(path)) is not None:
        kept.names.setdefault(identity, path)


def check_no_input(path: Path) -> None:
    """Raises ``FileFormatError`` where a file to be written or deleted is an input of the command that runs."""
    kept = _kept.get()
    if kept is not None and (source := kept.names.get(_identity(path))) is not None:  # type: ignore[arg-type]
        raise _refused(f"{path}: cannot be written", source)


def _refused(what: str, source: Path) -> FileFormatError:
    kind = "folder" if source.is_dir() else "file"
    return FileFormatError(f"{what}, which is the input {source}, expected another {kind}: it would be lost")


def _identity(path: Path) -> Identity | None:
    with suppress(OSError, ValueError):  # ValueError: a NUL in the name
        status = os.stat(path)
        return status.st_dev, status.st_ino
    return None
