"""Large text in pieces of whole lines: words take up to fifty times the memory of the text that they are split from."""

from collections.abc import Iterator
from pathlib import Path

from torchface.errors import FileFormatError

_PIECE = 2**20  # bytes


def line_pieces(
    path: Path, data: bytes, start: int = 0, end: int | None = None, unread: tuple[bytes, ...] = ()
) -> Iterator[bytes]:
    """The text between two places in pieces that end where a line does, without lines of any length that begin
    ``unread``."""
    end = len(data) if end is None else end
    while start < end:
        cut = end
        if end - start > _PIECE:
            cut = 1 + data.rfind(b"\n", start, start + _PIECE)
            if cut == 0:  # old machines end lines by a carriage return alone
                cut = 1 + data.rfind(b"\r", start, start + _PIECE)
            if cut == 0 and data.startswith(unread, start):
                start = 1 + data.find(b"\n", start, end) or end
                continue
            if cut == 0:
                raise FileFormatError(f"{path}: found a line of more than {_PIECE} bytes, expected shorter ones")
        yield data[start:cut]
        start = cut


def word_pieces(path: Path, data: bytes) -> Iterator[list[bytes]]:
    """The words, as many at a time as stand in a piece; lines do not matter."""
    start = 0
    while start < len(data):
        words = data[start : start + _PIECE].split()
        if start + _PIECE < len(data) and not data[start + _PIECE - 1 : start + _PIECE].isspace():
            if len(words) < 2:
                raise FileFormatError(f"{path}: found a word of more than {_PIECE} bytes, expected numbers")
            start += _PIECE - len(words.pop())  # it may go on in the next piece
        else:
            start += _PIECE
        yield words
