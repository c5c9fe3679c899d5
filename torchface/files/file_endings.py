"""Endings of files that are written, looked at before the work that fills them."""

from __future__ import annotations

from pathlib import Path

from torchface.errors import FileFormatError


def check_ending(path: str | Path, *endings: str) -> None:
    """Refuses a file whose name does not end as what is written into it.

    Args:
        path: of the file.
        endings: those that it may have, with their dots, lower case; upper case will do, too.

    Raises:
        FileFormatError: another ending, or none.

    Example:
        >>> check_ending("weights.CSV", ".csv")
        >>> check_ending("weights.xlsx", ".csv")
        Traceback (most recent call last):
            ...
        torchface.errors.FileFormatError: weights.xlsx: found the ending '.xlsx', expected .csv
    """
    suffix = Path(path).suffix
    if suffix.lower() not in endings:
        raise FileFormatError(f"{path}: found the ending {suffix!r}, expected {', '.join(endings)}")
