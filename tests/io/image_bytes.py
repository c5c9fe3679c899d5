"""Image files put together byte by byte, of any size they claim, by the formats' specifications and no library."""

import struct
import zlib
from collections.abc import Sequence

import numpy as np

PNG_START = b"\x89PNG\r\n\x1a\n"
_LETTERS = {1: "B", 3: "H", 4: "I", 16: "Q"}
Tag = tuple[int, int, Sequence[int]]
"""A TIFF's tag: number, type, values."""


def png_chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk with its length and checksum."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_header(width: int, height: int, bits: int, color: int, interlaced: int = 0) -> bytes:
    """The chunk that begins a PNG."""
    return png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, interlaced))


def png(
    samples: np.ndarray,
    bits: int,
    color: int,
    before: Sequence[tuple[bytes, bytes]] = (),
    after: Sequence[tuple[bytes, bytes]] = (),
) -> bytes:
    """A PNG of samples (H,W,C), whole numbers below ``2**bits``, with chunks before and after the pixels."""
    height, width, _ = samples.shape
    rows = []
    for row in samples.reshape(height, -1):  # each begins at a byte of its own
        digits = np.unpackbits(row.astype(">u2").view(np.uint8).reshape(-1, 2), axis=1)[:, 16 - bits :]
        rows.append(b"\0" + np.packbits(digits.ravel()).tobytes())
    parts = [png_header(width, height, bits, color), *(png_chunk(*chunk) for chunk in before)]
    parts += [png_chunk(b"IDAT", zlib.compress(b"".join(rows))), *(png_chunk(*chunk) for chunk in after)]
    return PNG_START + b"".join(parts) + png_chunk(b"IEND", b"")


def tiff_directory(tags: Sequence[Tag], at: int, order: str = "<", following: int = 0) -> bytes:
    """A directory that lies at an offset, with the values that do not fit into it behind it."""
    rows, values = [], b""
    behind = at + 2 + 12 * len(tags) + 4
    for number, kind, numbers in tags:
        packed = struct.pack(f"{order}{len(numbers)}{_LETTERS[kind]}", *numbers)
        if len(packed) > 4:
            packed, values = struct.pack(f"{order}I", behind + len(values)), values + packed
        rows.append(struct.pack(f"{order}HHI", number, kind, len(numbers)) + packed.ljust(4, b"\0"))
    return struct.pack(f"{order}H", len(tags)) + b"".join(rows) + struct.pack(f"{order}I", following) + values


def tiff(
    samples: np.ndarray, photometric: int, sample_format: int = 1, order: str = "<", tags: Sequence[Tag] = ()
) -> bytes:
    """A TIFF of samples (H,W,C) of any kind, in one strip, uncompressed."""
    height, width, count = samples.shape
    pixels = samples.astype(samples.dtype.newbyteorder(order)).tobytes()
    own: list[Tag] = [
        *((256, 4, [width]), (257, 4, [height]), (258, 3, [8 * samples.itemsize] * count), (259, 3, [1])),
        *((262, 3, [photometric]), (273, 4, [8]), (277, 3, [count]), (278, 4, [height]), (279, 4, [len(pixels)])),
        *((339, 3, [sample_format] * count), *([(338, 3, [2])] if count in (2, 4) else []), *tags),
    ]
    start = struct.pack(f"{order}2sHI", b"II" if order == "<" else b"MM", 42, 8 + len(pixels))
    return start + pixels + tiff_directory(sorted(own), 8 + len(pixels), order)


def exif(orientation: int, order: str = "<") -> bytes:
    """What an EXIF block holds."""
    start = struct.pack(f"{order}2sHI", b"II" if order == "<" else b"MM", 42, 8)
    return start + tiff_directory([(274, 3, [orientation])], 8, order)


def jpeg_segment(marker: int, content: bytes) -> bytes:
    """A segment with its length."""
    return struct.pack(">BBH", 0xFF, marker, len(content) + 2) + content


def riff_part(kind: bytes, content: bytes) -> bytes:
    """A part of a WebP or AVI with its length."""
    return kind + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2)


def webp(parts: Sequence[tuple[bytes, bytes]]) -> bytes:
    """A WebP of these parts."""
    content = b"WEBP" + b"".join(riff_part(*part) for part in parts)
    return b"RIFF" + struct.pack("<I", len(content)) + content


def webp_canvas(width: int, height: int, flags: int) -> bytes:
    """The part of a WebP that says how large its canvas is."""
    return struct.pack("<I", flags) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
