"""The two forms of a glTF file: one binary, or JSON with its buffers beside it or inside it."""

import base64
import binascii
import json
import reprlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from numpy.typing import NDArray

from torchface.errors import FileFormatError
from torchface.files.documents import parse_json
from torchface.files.extra_packages import import_extra
from torchface.files.whole_files import LARGEST_FILE, read_file
from torchface.io.gltf.buffers import BufferWriter

_MAGIC, _JSON_CHUNK, _BINARY_CHUNK = b"glTF", 0x4E4F534A, 0x004E4942
_MAX_JSON = 2**26
_MAX_JSON_WITH_BUFFERS = 2**28
_UNPACKED_ALWAYS = 2**28
_UNPACKED_PER_BYTE = 32
_SHORT = reprlib.Repr()
_SHORT.maxstring = 60
_MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
DRACO = "KHR_draco_mesh_compression"
_EXTENSIONS = (
    *("KHR_mesh_quantization", *_MESHOPT, DRACO, "KHR_texture_transform", "KHR_texture_basisu", "EXT_texture_webp"),
    *("KHR_materials_", "KHR_lights_punctual"),
)
"""Extensions a file may require: the first three are read, the others change no vertex."""


def shown(value: object) -> str:
    """A value of the file for an error's text, cut where it is long."""
    return _SHORT.repr(value)


@dataclass
class Document:
    """A glTF document whose every access is checked; errors name the file and the place in it."""

    path: Path
    root: dict[str, Any]
    binary: memoryview | None = None  # the binary chunk of a .glb
    # rows of accessors that Draco has packed, by their number
    unpacked_accessors: dict[int, NDArray[Any]] = field(default_factory=dict)
    _sources: dict[str, memoryview] = field(default_factory=dict)
    _unpacked_views: dict[str, memoryview] = field(default_factory=dict)
    _unpacked: int = 0

    def error(self, where: str, found: object, expected: str) -> FileFormatError:
        """An error to raise; ``found`` is in words, or what ``shown`` makes of a value."""
        return FileFormatError(f"{self.path}: {where}: found {found}, expected {expected}")

    def objects(self, kind: str) -> list[dict[str, Any]]:
        """A top-level array such as ``"accessors"``, empty where absent."""
        return [self.record(row, f"{kind}[{i}]") for i, row in enumerate(self.array(self.root, kind, "document"))]

    def item(self, kind: str, index: object, where: str) -> dict[str, Any]:
        """The object of a top-level array that ``index`` names."""
        rows = self.array(self.root, kind, "document")
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(rows):
            raise self.error(where, shown(index), f"an index into the {len(rows)} {kind}")
        return self.record(rows[index], f"{kind}[{index}]")

    def record(self, value: object, where: str) -> dict[str, Any]:
        """``value`` where it is an object; an absent one is empty."""
        if value is None:
            return {}
        if not isinstance(value, dict):
            raise self.error(where, shown(value), "an object")
        return value

    def array(self, parent: dict[str, Any], key: str, where: str) -> list[Any]:
        """An array field, empty where absent."""
        value = parent.get(key, [])
        if not isinstance(value, list):
            raise self.error(f"{where}.{key}", shown(value), "an array")
        return value

    def integer(self, parent: dict[str, Any], key: str, where: str, default: int | None = None) -> int:
        """A field that is an integer from 0 to 2**53."""
        value = parent.get(key, default)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**53:
            raise self.error(f"{where}.{key}", shown(value), "a non-negative integer")
        return value

    def numbers(self, parent: dict[str, Any], key: str, where: str, count: int) -> list[float] | None:
        """A field of ``count`` finite numbers; none where absent."""
        value = parent.get(key)
        if value is None:
            return None
        plain = isinstance(value, list) and len(value) == count
        if not plain or not all(isinstance(x, int | float) and abs(x) < 1e30 for x in value):
            raise self.error(f"{where}.{key}", shown(value), f"{count} finite numbers")
        return [float(x) for x in value]

    def first_extras(self, key: str) -> tuple[dict[str, Any], str] | None:
        """The first mesh whose ``extras.torchface`` holds something under a key, and the place of that in words."""
        for i, mesh in enumerate(self.objects("meshes")):
            extras = mesh.get("extras")
            ours = extras.get("torchface") if isinstance(extras, dict) else None
            if isinstance(ours, dict) and ours.get(key):
                return mesh, f"meshes[{i}].extras.torchface"
        return None

    def view(self, index: object, where: str) -> tuple[memoryview, int | None]:
        """The bytes of a bufferView, and its stride."""
        view = self.item("bufferViews", index, where)
        location = f"bufferViews[{index}]"
        extensions = self.record(view.get("extensions"), f"{location}.extensions")
        for name in _MESHOPT:
            if name in extensions:
                where = f"{location}.extensions.{name}"
                return self._decompressed(self.record(extensions[name], where), where)
        start, length = self.integer(view, "byteOffset", location, 0), self.integer(view, "byteLength", location)
        buffer = self._buffer(self.integer(view, "buffer", location))
        if start + length > len(buffer):
            raise self.error(location, f"bytes {start} to {start + length}", f"at most the buffer's {len(buffer)}")
        stride = self.integer(view, "byteStride", location) if "byteStride" in view else None
        return buffer[start : start + length], stride

    def _decompressed(self, packed: dict[str, Any], location: str) -> tuple[memoryview, int]:
        """The bytes of a bufferView that meshoptimizer has packed, and their stride; unpacked once."""
        if location not in self._unpacked_views:
            count, stride = self.integer(packed, "count", location), self.integer(packed, "byteStride", location)
            start, length = (
                self.integer(packed, "byteOffset", location, 0),
                self.integer(packed, "byteLength", location),
            )
            buffer = self._buffer(self.integer(packed, "buffer", location))
            if start + length > len(buffer):
                raise self.error(location, f"bytes {start} to {start + length}", f"at most the buffer's {len(buffer)}")
            meshopt = import_extra("meshopt", "meshopt", "compressed", f"{self.path}: meshopt compression")
            self.reserve(count * stride, location)
            mode, kept = packed.get("mode"), packed.get("filter", "NONE")
            try:
                rows = meshopt.decode_gltf_buffer(bytes(buffer[start : start + length]), count, stride, mode, kept)
            except (ValueError, TypeError, RuntimeError, OverflowError, MemoryError) as error:
                raise self.error(location, f"broken data ({str(error)[:80]})", "what meshoptimizer packs") from error
            self._unpacked_views[location] = memoryview(rows).cast("B")
        return self._unpacked_views[location], self.integer(packed, "byteStride", location)

    def bytes_at(self, uri: object, where: str) -> memoryview:
        """The bytes that a URI names: data in it, or a file in the document's folder or below; read once."""
        if not isinstance(uri, str):
            raise self.error(where, shown(uri), "a URI")
        if uri.startswith("data:"):
            if uri not in self._sources:
                self._sources[uri] = self._decoded(uri, where)
            return self._sources[uri]
        folder = self.path.resolve().parent
        try:
            file = (folder / unquote(uri)).resolve()
        except (OSError, ValueError, RuntimeError) as error:
            raise self.error(where, f"'{uri[:60]}'", f"a file name ({error})") from error
        if "://" in uri or not file.is_relative_to(folder):
            raise self.error(where, f"'{uri[:60]}'", "a file in the folder of the document")
        if str(file) not in self._sources:
            self._sources[str(file)] = memoryview(read_file(file, LARGEST_FILE - self._packed()))
        return self._sources[str(file)]

    def reserve(self, size: int, where: str) -> None:
        """Counts memory about to be taken; refuses more than files of this size can reasonably unpack to."""
        self._unpacked += size
        limit = max(_UNPACKED_ALWAYS, _UNPACKED_PER_BYTE * self._packed())
        if self._unpacked > limit:
            raise self.error(where, f"data that unpacks to {self._unpacked} bytes", f"at most {limit}")

    def _packed(self) -> int:
        """Bytes of the binary chunk and of all sources so far."""
        return len(self.binary or b"") + sum(map(len, self._sources.values()))

    def _decoded(self, uri: str, where: str) -> memoryview:
        head, _, body = uri.partition(",")
        if not head.endswith(";base64"):
            raise self.error(where, f"'{head[:60]}'", "base64 data")
        try:
            return memoryview(base64.b64decode(body, validate=True))
        except (binascii.Error, ValueError) as error:
            raise self.error(where, f"broken base64 ({error})", "base64 data") from error

    def _buffer(self, index: int) -> memoryview:
        buffer = self.item("buffers", index, f"buffers[{index}]")
        location = f"buffers[{index}]"
        length = self.integer(buffer, "byteLength", location)
        if buffer.get("uri") is None:
            if index != 0 or self.binary is None:
                raise self.error(location, "no uri", "one, or the binary chunk of a .glb")
            data = self.binary
        else:
            data = self.bytes_at(buffer["uri"], f"{location}.uri")
        if len(data) < length:
            raise self.error(location, f"{len(data)} bytes (truncated)", f"byteLength {length}")
        return data[:length]


def read_document(path: str | Path) -> Document:
    """Opens a ``.glb`` or ``.gltf``, by its first bytes."""
    path = Path(path)
    document = document_of(path, read_file(path))
    for name in document.array(document.root, "extensionsRequired", "document"):
        if not isinstance(name, str) or not name.startswith(_EXTENSIONS):
            known = ", ".join(start + "*" * start.endswith("_") for start in _EXTENSIONS)
            hint = "; decompress it: npx @gltf-transform/cli copy IN.glb OUT.glb" * ("compression" in shown(name))
            raise document.error("extensionsRequired", shown(name), f"none but {known}{hint}")
    return document


def document_of(path: Path, data: bytes) -> Document:
    """A document of a file's bytes, whatever extensions it requires: its vertices may be compressed."""
    if data[:4] == _MAGIC:
        text, binary = _chunks(path, data)
    else:
        text, binary = data, None
        if not data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
            raise FileFormatError(f"{path}: found neither 'glTF' nor JSON at its start, expected a glTF 2.0 file")
    largest = _MAX_JSON_WITH_BUFFERS if binary is None else _MAX_JSON
    if len(text) > largest:
        raise FileFormatError(f"{path}: found {len(text)} bytes of JSON, expected at most {largest}")
    try:
        root = parse_json(text)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: found broken JSON ({str(error)[:100]}), expected a glTF 2.0 file") from error
    if not isinstance(root, dict) or not isinstance(root.get("asset"), dict):
        raise FileFormatError(f"{path}: found JSON without 'asset', expected a glTF 2.0 file")
    document = Document(path, root, binary)
    version = root["asset"].get("version")
    if not isinstance(version, str) or not version.startswith("2."):
        raise document.error("asset.version", shown(version), "'2.0'")
    return document


def _chunks(path: Path, data: bytes) -> tuple[bytes, memoryview | None]:
    if len(data) < 20:
        raise FileFormatError(f"{path}: found {len(data)} bytes (truncated), expected a .glb of at least 20")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise FileFormatError(f"{path}: found glTF container version {version}, expected 2")
    if length > len(data):
        raise FileFormatError(f"{path}: found {len(data)} bytes (truncated), expected the {length} its header names")
    at, text, binary = 12, None, None
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        at += 8
        if at + size > length:
            raise FileFormatError(f"{path}: found {length - at} bytes in a chunk (truncated), expected {size}")
        if kind == _JSON_CHUNK and text is None:
            text = data[at : at + size]
        elif kind == _BINARY_CHUNK and binary is None:
            binary = memoryview(data)[at : at + size]
        at += size
    if text is None:
        raise FileFormatError(f"{path}: found no JSON chunk, expected a glTF 2.0 file")
    return text, memoryview(b"") if binary is None else binary


def glb_pieces(root: dict[str, Any], buffers: BufferWriter, source: str | Path = "glTF") -> Iterator[bytes]:
    """A ``.glb`` of one scene whose root is the first node, in pieces to write one behind the other."""
    root = {
        "asset": {"version": "2.0", "generator": "torchface"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        **root,
        "accessors": buffers.accessors,
        "bufferViews": buffers.views,
        "buffers": [{"byteLength": buffers.size}, *root.get("buffers", [])[1:]],
    }
    text = json.dumps(root, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + buffers.size  # views begin and end at multiples of four
    if size >= 2**32:
        raise FileFormatError(f"{source}: would take {size} bytes, expected less than 4 GB for a .glb")
    yield _MAGIC + struct.pack("<II", 2, size) + struct.pack("<II", len(text), _JSON_CHUNK)
    yield text
    yield struct.pack("<II", buffers.size, _BINARY_CHUNK)
    yield from buffers.pieces
