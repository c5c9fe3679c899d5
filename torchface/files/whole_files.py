"""Whole files in and out: refused before they fill the memory, replaced only when they are complete."""

from __future__ import annotations

import os
from pathlib import Path

from torchface.errors import FileFormatError

LARGEST_FILE = 2**31
"""Bytes; what a head rig with hundreds of shapes stays well below."""


def read_file(path: str | Path, largest: int = LARGEST_FILE) -> bytes:
    """The bytes of a file.

    Raises:
        FileFormatError: the file is missing, no plain file, empty, or larger than ``largest`` bytes.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise FileFormatError(f"{path}: found no such file, expected an existing one")
        if not path.is_file():
            raise FileFormatError(f"{path}: found a folder or a device, expected a plain file")
        size = path.stat().st_size
        if size == 0:
            raise FileFormatError(f"{path}: found an empty file, expected content")
        if size > largest:
            raise FileFormatError(f"{path}: found {size} bytes, expected at most {largest}")
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise FileFormatError(f"{path}: cannot be read ({error})") from error


def write_file(path: str | Path, data: bytes) -> None:
    """Writes a file that appears only when it is complete.

    Raises:
        FileFormatError: the folder is missing or cannot be written to.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise FileFormatError(f"{path}: cannot be written ({error.strerror})") from error


def make_folder(folder: str | Path) -> Path:
    """The folder, made with those above it where it is not there yet.

    Raises:
        FileFormatError: it cannot be made.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise FileFormatError(
            f"{folder}: found no folder, and it cannot be made ({getattr(error, 'strerror', error)}); expected a place "
            "that can be written to"
        ) from error
    return folder


def check_writable(*paths: Path | None) -> None:
    """Looks whether files or folders could be made, before long work; makes nothing.

    Raises:
        FileFormatError: what is there above one of them is no folder, or may not be written to.
    """
    for path in paths:
        if path is None:
            continue
        above = next(folder for folder in path.absolute().parents if os.path.lexists(folder))
        if not above.is_dir() or not os.access(above, os.W_OK):
            raise FileFormatError(f"{path}: cannot be written ({above} is no folder that can be written to)")
