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
