"""Files that belong to another one and that the user did not name: what the user has there is never replaced."""

import hashlib
import itertools
import warnings
import zlib
from collections.abc import Mapping
from pathlib import Path

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file, write_file

_PNG = b"\x89PNG"
_NOTE = b"Comment\0torchface keeps this for "  # of a PNG's tEXt chunk
_LINE = b"# torchface keeps this for "  # before the text of another file
_AFTER_HEADER = 33  # bytes of a PNG's signature and header


def write_beside(path: Path, parts: Mapping[str, bytes]) -> None:
    """Writes parts of ``path``, PNG or lines of text, beside it, by name, each with a note of whose it is."""
    for name, data in parts.items():
        other = path.with_name(name)
        check_beside(path, other, data)
        if not (other.is_file() and _without_note(read_file(other)) == data):
            write_file(other, _with_note(data, path.name))


def check_beside(path: Path, other: Path, data: bytes | None = None) -> None:
    """Refuses a file that is not torchface's for ``path``; ``data`` is what would be written, where it is known."""
    if not _gives_way(path, other, data):
        raise FileFormatError(
            f"{other}: found a file where {path.name} keeps a part of its own, expected none; "
            f"another name in place of {path.name} keeps both"
        )


def free_stem(path: Path, stem: str, parts: Mapping[str, bytes]) -> str:
    """What names of parts begin with where the user's files stay: ``stem``, or ``stem_2`` and so on, with a warning."""
    for candidate in itertools.chain([stem], (f"{stem}_{number}" for number in itertools.count(2))):
        places = {candidate + name.removeprefix(stem): data for name, data in parts.items()}
        if all(_gives_way(path, path.with_name(name), data) for name, data in places.items()):
            break
    if candidate != stem:
        kept = [name for name, data in parts.items() if not _gives_way(path, path.with_name(name), data)]
        warnings.warn(
            f"{path.name}: found {', '.join(kept)} beside it, which torchface did not write for it, or which was "
            f"changed since; it is kept, and {path.name} takes {', '.join(places)}",
            stacklevel=2,
        )
    return candidate


def _gives_way(path: Path, other: Path, data: bytes | None) -> bool:
    if not other.is_file():
        return True
    found = read_file(other)
    plain = _without_note(found)
    return plain == data or _with_note(plain, path.name) == found


def _with_note(data: bytes, owner: str) -> bytes:
    said = f"{owner}: {hashlib.sha256(data).hexdigest()}".encode()
    if not data.startswith(_PNG):
        return _LINE + said + b"\n" + data
    text = b"tEXt" + _NOTE + said
    chunk = (len(text) - 4).to_bytes(4, "big") + text + zlib.crc32(text).to_bytes(4, "big")
    return data[:_AFTER_HEADER] + chunk + data[_AFTER_HEADER:]


def _without_note(data: bytes) -> bytes:
    if data.startswith(_LINE):
        return data.partition(b"\n")[2]
    length, begin = data[_AFTER_HEADER : _AFTER_HEADER + 4], _AFTER_HEADER + 4
    if data.startswith(_PNG) and data[begin:].startswith(b"tEXt" + _NOTE):
        return data[:_AFTER_HEADER] + data[begin + 8 + int.from_bytes(length, "big") :]
    return data
