"""Width and height on the command line."""

from __future__ import annotations

import re


def picture_size(text: str) -> tuple[int, int]:
    """Width and height of a text such as 1280x720.

    Raises:
        ValueRangeError: it is no such text.
    """
    from torchface.errors import ValueRangeError

    match = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text.strip().lower())
    if match is None or not (int(match[1]) and int(match[2])):
        raise ValueRangeError(f"--size: found {text[:40]!r}, expected WIDTHxHEIGHT in pixels, such as 1280x720")
    return int(match[1]), int(match[2])
