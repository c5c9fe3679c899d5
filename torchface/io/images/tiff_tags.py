"""The first directory of a TIFF, of which EXIF is one: its numbers, read without trusting a size."""

import struct
from dataclasses import dataclass

from torchface.errors import FileFormatError

WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC = 256, 257, 258, 259, 262
ORIENTATION, SAMPLES, TILE_WIDTH, TILE_HEIGHT, SAMPLE_FORMAT = 274, 277, 322, 323, 339
SUBFILE, DNG_VERSION, ICC_PROFILE = 254, 50706, 34675
_WANTED = {
    *(WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, ORIENTATION, SAMPLES, TILE_WIDTH, TILE_HEIGHT, SAMPLE_FORMAT),
    *(SUBFILE, DNG_VERSION),
}
_METADATA = {ORIENTATION, 700, 34665, 34853}  # XMP, EXIF, GPS
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_LETTERS = {1: "B", 3: "H", 4: "I", 16: "Q"}
_MOST_VALUES = 16


@dataclass(frozen=True)
class _Entry:
    """A tag, the kind and number of its values, where it is and where they are."""

    row: int
    tag: int
    kind: int
    number: int
    place: int


def first_directory(data: bytes, source: str) -> dict[int, tuple[int, ...]]:
    """The whole numbers of those tags of a TIFF's first directory that describe its pixels.

    Decoders copy what each tag points at, and thousands of tags may point at one place: a directory that claims more
    bytes than the file has is refused.
    """
    values: dict[int, tuple[int, ...]] = {}
    try:
        order, entries = _entries(data, source)
        for entry in entries:
            if entry.tag in _WANTED and entry.kind in _LETTERS and 0 < entry.number <= _MOST_VALUES:
                letters = f"{order}{entry.number}{_LETTERS[entry.kind]}"
                values.setdefault(entry.tag, struct.unpack_from(letters, data, entry.place))
    except (struct.error, OverflowError) as error:
        raise FileFormatError(f"{source}: found tags that are cut off ({error})") from error
    return values


def tag_bytes(data: bytes, source: str, tag: int) -> bytes:
    """What a tag of a TIFF's first directory points at; empty without it."""
    found = next((entry for entry in _entries(data, source)[1] if entry.tag == tag), None)
    return b"" if found is None else data[found.place : found.place + found.number * _SIZES.get(found.kind, 0)]


def without_metadata(data: bytes, source: str) -> bytes:
    """A TIFF without the tags of its first directory that lead decoders elsewhere; :func:`first_directory` took it.

    Pillow turns an image as its tags or its XMP say, copying whole directories that they point at; OpenCV turns some.
    """
    rows = [entry for entry in _entries(data, source)[1] if entry.tag in _METADATA]
    if not rows:
        return data
    changed = bytearray(data)
    for entry in rows:
        changed[entry.row : entry.row + 2] = b"\xff\xff"
    return bytes(changed)


def _entries(data: bytes, source: str) -> tuple[str, list[_Entry]]:
    """The byte order, as ``struct`` writes it, and the tags of the first directory."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2], "")
    version = struct.unpack_from(f"{order}H", data, 2)[0] if order else 0
    if version not in (42, 43):
        raise FileFormatError(f"{source}: found {data[:4]!r} at the start of its tags, expected those of a TIFF")
    big = version == 43
    offset = order + ("Q" if big else "I")
    (at,) = struct.unpack_from(offset, data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, at)
    head, room = (order + "HHQ", 8) if big else (order + "HHI", 4)
    at, step = at + (8 if big else 2), struct.calcsize(head) + room
    if count * step > len(data) - at:
        raise FileFormatError(f"{source}: found {count} tags in {len(data)} bytes, expected fewer (cut off?)")
    entries, claimed = list[_Entry](), 0
    for row in range(at, at + count * step, step):
        tag, kind, number = struct.unpack_from(head, data, row)
        value_at, size = row + step - room, _SIZES.get(kind, 1) * number
        if size > room:
            (value_at,) = struct.unpack_from(offset, data, value_at)
            claimed += size
        if claimed > len(data):
            raise FileFormatError(f"{source}: found tags that claim more than the {len(data)} bytes that there are")
        entries.append(_Entry(row, tag, kind, number, value_at))
    return order, entries


def exif_orientation(exif: bytes, source: str) -> int:
    """EXIF's orientation, 1 (upright) to 8; 1 where there is none, and where the block is damaged, as viewers do."""
    try:
        return plausible_orientation(first_directory(exif.removeprefix(b"Exif\0\0"), source))
    except FileFormatError:
        return 1


def plausible_orientation(tags: dict[int, tuple[int, ...]]) -> int:
    """The orientation of tags, 1 to 8; another number, which viewers ignore too, is 1."""
    number = tags.get(ORIENTATION, (1,))[0]
    return number if 1 <= number <= 8 else 1
