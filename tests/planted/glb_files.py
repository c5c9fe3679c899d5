"""A ``.glb`` taken apart and put together without torchface, as a stranger's program might."""

import json
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


def packed(root: Mapping[str, Any], binary: bytes, extra: bytes = b"") -> bytes:
    """A ``.glb`` of a JSON and its binary chunk, with an unknown chunk of ``extra`` behind."""
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    if extra:
        chunks += struct.pack("<II", len(extra), 0x54534554) + extra
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def unpacked(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk of a ``.glb``."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    at = 20 + size
    length = struct.unpack_from("<I", data, at)[0]
    return json.loads(data[20:at]), data[at + 8 : at + 8 + length]


def rewrite(path: Path, change: Callable[[dict[str, Any]], object], out: Path | None = None) -> Path:
    """Applies ``change`` to the JSON of a ``.glb``, in its place or into another file."""
    root, binary = unpacked(path)
    change(root)
    out = out or path
    out.write_bytes(packed(root, binary))
    return out
