"""A glTF mesh as one part of a rig: its primitives' vertices, triangles and morph targets put together."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchface.color_space import to_srgb
from torchface.io.gltf.accessors import read_floats, read_indices
from torchface.io.gltf.draco_primitives import unpack_draco
from torchface.io.gltf.gltf_document import Document, shown

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MAX_EXACT_ID = 2**24

BYTES_A_VERTEX, BYTES_A_CORNER = 200, 40
"""What a vertex without its morph targets, and a triangle's corner, take while they are read."""


@dataclass(frozen=True)
class MaterialLook:
    """A base colour: index of its texture, and the linear colour that it is multiplied by."""

    texture: int | None = None
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Part:
    """A mesh as the file has it: C vertices, split wherever texture coordinates differ."""

    positions: NDArray[np.float32]  # (C,3), the file's unit and the mesh's own axes
    deltas: NDArray[np.float32]  # (N,C,3), one a name
    names: tuple[str, ...]
    triangles: NDArray[np.int64]  # (F,3) into the C vertices
    uvs: NDArray[np.float32] | None  # (C,2), origin at the lower left
    colors: NDArray[np.float32] | None  # (C,3) in [0,1], encoded as images are
    vertex_ids: NDArray[np.int64] | None  # (C,), which vertex of the mesh as authored each was split from
    # The texture and colour of the triangles, and of how many, in their order.
    looks: tuple[tuple[MaterialLook, int], ...]
    extras: dict[str, Any]  # the mesh's extras
    attributes: tuple[tuple[dict[str, Any], int], ...]  # accessors of vertices that share them, and how many these are


def read_part(document: Document, index: int) -> Part | None:
    """The triangles of mesh ``index``; none where it has only points and lines."""
    location = f"meshes[{index}]"
    mesh = document.item("meshes", index, location)
    blocks: dict[str, _Block] = {}
    triangles, looks, first = [], [], 0
    for i, row in enumerate(document.array(mesh, "primitives", location)):
        primitive = document.record(row, f"{location}.primitives[{i}]")
        if primitive.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):
            continue
        # Exporters that split by material let all primitives share one set of vertices.
        look, texture = _look(document, primitive, f"{location}.primitives[{i}]")
        shared = [primitive.get("attributes"), primitive.get("targets"), texture.get("extensions")]
        key = json.dumps(shared, sort_keys=True)
        unpack_draco(document, primitive, f"{location}.primitives[{i}]")
        if key not in blocks:
            blocks[key] = _read_block(document, primitive, texture, f"{location}.primitives[{i}]", first)
            first += len(blocks[key].positions)
        corners = read_triangles(document, primitive, f"{location}.primitives[{i}]", len(blocks[key].positions))
        triangles.append(corners + blocks[key].first)
        painted = _painted(primitive)  # that texture is not of the mesh
        looks.append((MaterialLook() if painted else look, len(corners)))
    if not blocks:
        return None
    rows = list(blocks.values())
    if len({len(block.deltas) for block in rows}) > 1:
        counts = [len(block.deltas) for block in rows]
        raise document.error(location, f"primitives of {counts} morph targets", "the same number in each")
    return Part(
        np.concatenate([block.positions for block in rows]),
        rows[0].deltas if len(rows) == 1 else np.concatenate([block.deltas for block in rows], axis=1),
        _target_names(document, mesh, location, len(rows[0].deltas)),
        np.concatenate(triangles),
        filled([block.uvs for block in rows], [len(block.positions) for block in rows], 0.0),
        filled([block.colors for block in rows], [len(block.positions) for block in rows], 1.0),
        None if any(block.vertex_ids is None for block in rows) else np.concatenate([b.vertex_ids for b in rows]),
        tuple(looks),
        document.record(mesh.get("extras"), f"{location}.extras") if isinstance(mesh.get("extras"), dict) else {},
        tuple((block.attributes, len(block.positions)) for block in rows),
    )


@dataclass(frozen=True)
class _Block:
    """The vertices of one set of accessors; ``first`` is where they begin in the part."""

    first: int
    positions: NDArray[np.float32]
    deltas: NDArray[np.float32]
    uvs: NDArray[np.float32] | None
    colors: NDArray[np.float32] | None
    vertex_ids: NDArray[np.int64] | None
    attributes: dict[str, Any]


def read_positions(
    document: Document, primitive: dict[str, Any], location: str
) -> tuple[dict[str, Any], NDArray[np.float32]]:
    """The attributes of a primitive, and its positions (C,3)."""
    attributes = document.record(primitive.get("attributes"), f"{location}.attributes")
    if "POSITION" not in attributes:
        raise document.error(f"{location}.attributes", "no POSITION", "one")
    return attributes, read_floats(document, attributes["POSITION"], f"{location}.POSITION", ("VEC3",))


def read_uvs(
    document: Document, attributes: dict[str, Any], texture: dict[str, Any], location: str, count: int
) -> NDArray[np.float32] | None:
    """The coordinates (C,2) in a texture, by what a material says of it, origin at the lower left; none without them.

    ``KHR_texture_transform`` shifts, turns and scales them, as files with quantised coordinates need.
    """
    where = f"{location}.material.baseColorTexture"
    change = document.record(document.record(texture.get("extensions"), where).get("KHR_texture_transform"), where)
    name = f"TEXCOORD_{document.integer(change if 'texCoord' in change else texture, 'texCoord', where, 0)}"
    if name not in attributes:
        return None
    uvs = read_floats(document, attributes[name], f"{location}.{name}", ("VEC2",), count)
    across, down = (uvs * (document.numbers(change, "scale", where, 2) or (1.0, 1.0))).T
    if "rotation" in change:
        (turn,) = document.numbers({"rotation": [change["rotation"]]}, "rotation", where, 1) or (0.0,)
        across, down = (
            math.cos(turn) * across + math.sin(turn) * down,
            math.cos(turn) * down - math.sin(turn) * across,
        )
    right, below = document.numbers(change, "offset", where, 2) or (0.0, 0.0)
    return np.stack([across + right, 1 - (down + below)], axis=1).astype(np.float32)


def _read_block(
    document: Document, primitive: dict[str, Any], texture: dict[str, Any], location: str, first: int
) -> _Block:
    attributes, positions = read_positions(document, primitive, location)
    count = len(positions)
    document.reserve(count * BYTES_A_VERTEX, f"{location}.POSITION")
    targets = document.array(primitive, "targets", location)
    document.reserve(len(targets) * count * 12, f"{location}.targets")
    deltas = np.zeros((len(targets), count, 3), np.float32)
    for i, row in enumerate(targets):  # each target has accessors of its own
        target = document.record(row, f"{location}.targets[{i}]")
        if "POSITION" in target:
            deltas[i] = read_floats(document, target["POSITION"], f"{location}.targets[{i}].POSITION", ("VEC3",), count)
    uvs = read_uvs(document, attributes, texture, location, count)
    colors = ids = None
    color_name = "_COLOR" if "_COLOR" in attributes or _painted(primitive) else "COLOR_0"
    if color_name in attributes:
        colors = read_floats(document, attributes[color_name], f"{location}.{color_name}", ("VEC3", "VEC4"), count)
        colors = to_srgb(torch.from_numpy(colors[:, :3].clip(0, 1))).numpy()
    if "_VERTEX_ID" in attributes:
        numbers = read_floats(document, attributes["_VERTEX_ID"], f"{location}._VERTEX_ID", ("SCALAR",), count)[:, 0]
        whole = numbers == np.floor(numbers)
        ids = numbers.astype(np.int64) if bool(np.all(whole & (numbers >= 0) & (numbers < _MAX_EXACT_ID))) else None
    return _Block(first, positions, deltas, uvs, colors, ids, attributes)


def read_triangles(document: Document, primitive: dict[str, Any], location: str, count: int) -> NDArray[np.int64]:
    """The triangles (F,3) of a primitive of ``count`` vertices; strips and fans taken apart."""
    if primitive.get("indices") is None:
        corners = np.arange(count)
    else:
        corners = read_indices(document, primitive["indices"], f"{location}.indices")
    document.reserve(len(corners) * BYTES_A_CORNER, f"{location}.indices")
    if len(corners) and int(corners.max()) >= count:
        raise document.error(f"{location}.indices", int(corners.max()), f"less than the {count} vertices")
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _TRIANGLES:
        if len(corners) % 3:
            raise document.error(f"{location}.indices", f"{len(corners)} corners", "three a triangle")
        return corners.reshape(-1, 3)
    if len(corners) < 3:
        raise document.error(f"{location}.indices", f"{len(corners)} corners", "at least three")
    if mode == _FAN:
        return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
    odd = np.arange(len(corners) - 2) % 2  # every second triangle of a strip runs the other way
    steps = np.arange(len(corners) - 2)
    return np.stack([corners[steps], corners[steps + 1 + odd], corners[steps + 2 - odd]], axis=1)


def _look(document: Document, primitive: dict[str, Any], location: str) -> tuple[MaterialLook, dict[str, Any]]:
    """The base colour, and what the material says of its texture."""
    if primitive.get("material") is None:
        return MaterialLook(), {}
    material = document.item("materials", primitive["material"], f"{location}.material")
    surface = document.record(material.get("pbrMetallicRoughness"), f"{location}.material")
    red, green, blue, _ = document.numbers(surface, "baseColorFactor", f"{location}.material", 4) or (1.0,) * 4
    texture = document.record(surface.get("baseColorTexture"), f"{location}.material.baseColorTexture")
    if "index" not in texture:
        return MaterialLook(None, (red, green, blue)), {}
    index = document.integer(texture, "index", f"{location}.material.baseColorTexture")
    return MaterialLook(index, (red, green, blue)), texture


def _painted(primitive: dict[str, Any]) -> bool:
    """Whether ``writing`` has made the colours of a part that had none."""
    extras = primitive.get("extras")
    ours = extras.get("torchface") if isinstance(extras, dict) else None
    return isinstance(ours, dict) and ours.get("painted") is True


def read_target_names(document: Document, index: int) -> tuple[str, ...]:
    """The names of the morph targets of mesh ``index``."""
    location = f"meshes[{index}]"
    mesh = document.item("meshes", index, location)
    rows = document.array(mesh, "primitives", location)
    targets = [document.array(document.record(row, location), "targets", location) for row in rows[:1]]
    return _target_names(document, mesh, location, len(targets[0]) if targets else 0)


def moving_target_names(document: Document, index: int) -> frozenset[str]:
    """Of the morph targets of mesh ``index`` those that move a vertex, by the bounds that glTF demands of positions;
    those without bounds count."""
    location, moving = f"meshes[{index}]", set()
    for row in document.array(document.item("meshes", index, location), "primitives", location):
        targets = document.array(document.record(row, location), "targets", location)
        for name, target in zip(read_target_names(document, index), targets, strict=False):
            positions = document.record(target, location).get("POSITION")
            bounds = {} if positions is None else document.item("accessors", positions, location)
            ways = [document.numbers(bounds, key, location, 3) for key in ("min", "max")]
            if positions is not None and any(way is None or any(way) for way in ways):
                moving.add(name)
    return frozenset(moving)


def _target_names(document: Document, mesh: dict[str, Any], location: str, count: int) -> tuple[str, ...]:
    """From the mesh, as Blender and three.js have it, or its first primitive; else ``target_0`` and so on."""
    primitives = [row for row in document.array(mesh, "primitives", location) if isinstance(row, dict)]
    for owner in (mesh, *primitives[:1]):
        extras = owner.get("extras")
        names = extras.get("targetNames") if isinstance(extras, dict) else None
        if names is None:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise document.error(f"{location}.extras.targetNames", shown(names), "a list of names")
        if len(names) != count or len(set(names)) != count:
            counted = f"{len(names)} names, {len(set(names))} of them different"
            raise document.error(f"{location}.extras.targetNames", counted, f"one for each of {count} morph targets")
        return tuple(names)
    return tuple(f"target_{i}" for i in range(count))


def filled(
    arrays: Sequence[NDArray[np.float32] | None], counts: Sequence[int], filler: float
) -> NDArray[np.float32] | None:
    """The arrays in a line; one that is absent where another is not gets ``counts`` rows of the filler."""
    width = next((array.shape[1] for array in arrays if array is not None), None)
    if width is None:
        return None
    full = [
        np.full((count, width), filler, np.float32) if array is None else array
        for array, count in zip(arrays, counts, strict=True)
    ]
    return np.concatenate(full)
