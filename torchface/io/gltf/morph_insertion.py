"""Morph targets added to a binary glTF file; all else of it, and its numbering, stays as it was."""

import copy
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file, replaced_file
from torchface.io.gltf.accessors import read_floats
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.gltf_document import Document
from torchface.io.gltf.primitive_reading import read_target_names

_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
_JSON, _BINARY = 0x4E4F534A, 0x004E4942


@dataclass(frozen=True, eq=False)
class AddedTargets:
    """What new morph targets move of vertices that some primitives of a mesh share."""

    mesh: int
    primitives: tuple[int, ...]  # those that share the vertices
    positions: NDArray[np.float32]  # (N,C,3) in the mesh's own axes and unit, one for each new name
    normals: NDArray[np.float32] | None = None  # the same of the normals, or none


def document_with_targets(
    document: Document, added: Sequence[AddedTargets], names: Sequence[str], filled: Sequence[str] = ()
) -> tuple[dict[str, Any], bytes]:
    """The file's JSON with morph targets behind those that it has, and the bytes that come behind its binary chunk.

    Every mesh that ``added`` names gets all names, on each of its primitives; those that nothing moves get targets
    without data. Weights of meshes, nodes and animations get zeros for them.

    Args:
        names: of the new morph targets; a mesh has none of them but those ``filled``.
        filled: of them those that take the place of the target of that name in a mesh that has one.
    """
    root = copy.deepcopy(document.root)
    writer = AppendedArrays(document, root)
    for mesh in sorted({one.mesh for one in added}):
        moved: Mapping[int, AddedTargets] = {
            primitive: one for one in added if one.mesh == mesh for primitive in one.primitives
        }
        _extend_mesh(document, root, mesh, moved, (tuple(names), frozenset(filled)), writer)
    return writer.finished()


def write_edited(document: Document, root: Mapping[str, Any], appended: bytes, path: str | Path) -> None:
    """Writes a binary glTF with another JSON: its binary chunk, ``appended``, then its other chunks.

    The file appears only when it is complete.
    """
    start = document.root["buffers"][0]["byteLength"] if document.root.get("buffers") else 0
    binary = bytes(document.binary or b"")[:start] if appended else bytes(document.binary or b"")
    text = json.dumps(root, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4) + appended
    binary += b"\0" * (-len(binary) % 4)
    chunks = [(_JSON, text), *([(_BINARY, binary)] if binary else []), *_other_chunks(document.path)]
    size = _HEADER.size + sum(_CHUNK.size + len(data) for _, data in chunks)
    if size >= 2**32:
        raise FileFormatError(f"{path}: would take {size} bytes, expected less than 4 GB for a .glb")
    with replaced_file(path) as temporary, temporary.open("wb") as file:
        file.write(_HEADER.pack(b"glTF", 2, size))
        for kind, data in chunks:
            file.write(_CHUNK.pack(len(data), kind))
            file.write(data)


def _other_chunks(path: Path) -> list[tuple[int, bytes]]:
    """Chunks that are neither JSON nor the binary one, which readers of glTF 2 skip."""
    data, at, found = read_file(path), _HEADER.size, []
    taken: set[int] = set()
    while at + _CHUNK.size <= len(data):
        size, kind = _CHUNK.unpack_from(data, at)
        if kind in (_JSON, _BINARY) and kind not in taken:
            taken.add(kind)
        else:
            found.append((kind, data[at + _CHUNK.size : at + _CHUNK.size + size]))
        at += _CHUNK.size + size
    return found


class AppendedArrays:
    """Accessors and bufferViews behind those of a document whose first buffer is its binary chunk."""

    def __init__(self, document: Document, root: dict[str, Any]) -> None:
        first = document.root.get("buffers") or [{}]
        if document.binary is None or first[0].get("uri") is not None:
            raise document.error("buffers[0]", "its data in another file", "a .glb that holds it (gltf-transform copy)")
        self.document, self.root, self.buffers = document, root, BufferWriter()
        self.first_accessor = len(root.get("accessors", []))
        self.first_view = len(root.get("bufferViews", []))

    def deltas(self, rows: NDArray[np.float32]) -> int:
        return self.first_accessor + self.buffers.deltas(np.ascontiguousarray(rows, np.float32))

    def vertices(self, rows: NDArray[np.float32]) -> int:
        return self.first_accessor + self.buffers.vertices(np.ascontiguousarray(rows, np.float32))

    def joints(self, rows: NDArray[np.float32]) -> int:
        return self.first_accessor + self.buffers.joints(rows)

    def triangles(self, faces: NDArray[np.int64]) -> int:
        return self.first_accessor + self.buffers.triangles(faces)

    def texture(self, image: bytes) -> int:
        """A texture of a PNG, by a sampler of its own."""
        added: dict[str, Any] = {}
        self.buffers.texture(added, image)
        numbers = {key: len(self.root.get(key, [])) for key in ("samplers", "images", "textures")}
        added["images"][0]["bufferView"] += self.first_view
        added["textures"][0] = {"source": numbers["images"], "sampler": numbers["samplers"]}
        for key in numbers:
            self.root.setdefault(key, []).extend(added[key])
        return numbers["textures"]

    def numbers(self, rows: NDArray[np.float32]) -> int:
        return self.first_accessor + self.buffers.keys(np.ascontiguousarray(rows, np.float32))

    def finished(self) -> tuple[dict[str, Any], bytes]:
        length = self.document.root["buffers"][0]["byteLength"]
        start = length + -length % 4
        for view in self.buffers.views:
            view["byteOffset"] += start
        for accessor in self.buffers.accessors:
            sparse = accessor.get("sparse", {})
            for owner in (accessor, sparse.get("indices", {}), sparse.get("values", {})):
                if "bufferView" in owner:
                    owner["bufferView"] += self.first_view
        self.root.setdefault("bufferViews", []).extend(self.buffers.views)
        self.root.setdefault("accessors", []).extend(self.buffers.accessors)
        data = b"".join(self.buffers.pieces)
        self.root["buffers"][0]["byteLength"] = start + len(data)
        return self.root, data


def _extend_mesh(
    document: Document,
    root: dict[str, Any],
    index: int,
    moved: Mapping[int, AddedTargets],
    wanted: tuple[tuple[str, ...], frozenset[str]],
    writer: AppendedArrays,
) -> None:
    names, filled = wanted
    mesh, location = root["meshes"][index], f"meshes[{index}]"
    if not isinstance(mesh, dict):
        raise document.error(location, type(mesh).__name__, "an object")
    old = read_target_names(document, index)
    if twice := [name for name in names if name in old and name not in filled]:
        raise document.error(f"{location}.extras.targetNames", f"{twice[0]!r} already", "names that it lacks")
    written: dict[tuple[int, bool], list[dict[str, int]]] = {}
    for number, primitive in enumerate(document.array(mesh, "primitives", location)):
        if not isinstance(primitive, dict):
            raise document.error(f"{location}.primitives[{number}]", type(primitive).__name__, "an object")
        one = moved.get(number)
        attributes = document.record(primitive.get("attributes"), location)
        normals = "NORMAL" in attributes
        accessor = document.item("accessors", attributes.get("POSITION"), f"{location}.primitives[{number}]")
        count = document.integer(accessor, "count", location)
        key = (-count if one is None else id(one), normals)
        if key not in written:
            still = np.zeros((count, 3), np.float32)
            written[key] = []
            for row in range(len(names)):
                target = {"POSITION": writer.deltas(still if one is None else one.positions[row])}
                if normals:
                    turned = still if one is None or one.normals is None else one.normals[row]
                    target["NORMAL"] = writer.deltas(turned)
                written[key].append(target)
        targets = list(document.array(primitive, "targets", location))
        for name, target in zip(names, written[key], strict=True):
            if name in old:
                targets[old.index(name)] = target
            else:
                targets.append(target)
        primitive["targets"] = targets
    added = tuple(name for name in names if name not in old)
    _extend_names(document, mesh, location, (*old, *added))
    zeros = [0.0] * len(added)
    if "weights" in mesh or not old:
        mesh["weights"] = [*document.array(mesh, "weights", location), *zeros]
    nodes = [number for number, node in enumerate(document.objects("nodes")) if node.get("mesh") == index]
    for number in nodes:
        if "weights" in root["nodes"][number]:
            root["nodes"][number]["weights"] = [*document.array(root["nodes"][number], "weights", "nodes"), *zeros]
    _extend_animations(document, root, nodes, len(old), len(added), writer)


def _extend_names(document: Document, mesh: dict[str, Any], location: str, names: tuple[str, ...]) -> None:
    """The names where the file has them, at the mesh or at each of its primitives; else at the mesh."""
    owners = [one for one in (mesh, *mesh["primitives"]) if _has_names(one.get("extras"))] or [mesh]
    for owner in owners:
        extras = owner.get("extras") or {}
        if not isinstance(extras, dict):
            raise document.error(f"{location}.extras", type(extras).__name__, "an object, to name morph targets in")
        owner["extras"] = {**extras, "targetNames": list(names)}


def rename_targets(root: dict[str, Any], names: Mapping[str, str]) -> None:
    """Gives morph targets of a file other names, at meshes and their primitives; a name that is taken stays free."""
    for mesh in root.get("meshes", ()):
        for owner in (mesh, *mesh["primitives"]):
            if _has_names(owner.get("extras")):
                old = owner["extras"]["targetNames"]
                new = [one if names.get(one) in old else names.get(one, one) for one in old]
                owner["extras"] = {**owner["extras"], "targetNames": new}


def _has_names(extras: object) -> bool:
    return isinstance(extras, dict) and "targetNames" in extras


def _extend_animations(
    document: Document, root: dict[str, Any], nodes: list[int], old: int, new: int, writer: AppendedArrays
) -> None:
    """Zeros for the new targets in animations of the weights of these nodes."""
    for number, kept in enumerate(document.objects("animations")):
        if not kept:
            continue
        animation, where = root["animations"][number], f"animations[{number}]"
        samplers = document.array(animation, "samplers", where)
        for channel in document.array(animation, "channels", where):
            target = document.record(document.record(channel, where).get("target"), where)
            if not old or target.get("path") != "weights" or target.get("node") not in nodes:
                continue
            index = document.integer(channel, "sampler", where)
            if index >= len(samplers):
                raise document.error(f"{where}.channels", index, f"less than the {len(samplers)} samplers")
            sampler = document.record(samplers[index], where)
            values = read_floats(document, sampler.get("output"), where, ("SCALAR",))
            if len(values) % old:
                raise document.error(where, f"{len(values)} weights", f"{old} for each key")
            samplers.append(
                {
                    **sampler,
                    "output": writer.numbers(np.pad(values.reshape(-1, old), ((0, 0), (0, new))).reshape(-1, 1)),
                }
            )
            channel["sampler"] = len(samplers) - 1
