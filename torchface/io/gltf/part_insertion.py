"""Vertices, triangles and a part's image added to meshes of a binary glTF file; what it has keeps place and bytes."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from torchface.io.gltf.accessors import read_floats
from torchface.io.gltf.character_scene import Block, Character
from torchface.io.gltf.gltf_document import Document
from torchface.io.gltf.morph_insertion import AppendedArrays

_TYPES = ("SCALAR", "VEC2", "VEC3", "VEC4")
_MATERIAL = "eyes and inside of the mouth"


@dataclass(frozen=True, eq=False)
class ExtendedBlock:
    """A block of a character with n vertices more, behind the C that it has."""

    block: int
    # Of the block's own vertices, by which the new ones take what they are not given, (n,C), sparse.
    shares: sparse.csr_array
    places: NDArray[np.float64]  # in the scene, (n,3)
    normals: NDArray[np.float64]  # in the scene, (n,3)
    faces: Mapping[int, NDArray[np.int64]]  # all triangles of each of its primitives
    uvs: NDArray[np.float64]  # texture coordinates, origin at the lower left, (n,2); NaN where they are taken by share
    parts: NDArray[np.int64] | None  # triangles in the material of the parts, (P,3), or none
    # How the new ones move in morph targets that the block has, by their rows, (n,3) in the array's axes; NaN and other
    # targets by share.
    moves: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)


def document_with_parts(character: Character, blocks: Sequence[ExtendedBlock], page: bytes) -> Document:
    """The character's file with more vertices and a PNG: accessors, bufferViews and bytes behind those it has."""
    document = character.document
    root, writer = copy.deepcopy(document.root), None
    writer = AppendedArrays(document, root)
    texture = writer.texture(page)
    surface = {"baseColorTexture": {"index": texture}, "metallicFactor": 0.0, "roughnessFactor": 0.35}
    root.setdefault("materials", []).append({"name": _MATERIAL, "pbrMetallicRoughness": surface, "doubleSided": True})
    for one in blocks:
        _extend(character, one, root, writer, len(root["materials"]) - 1)
    root, data = writer.finished()
    start = document.root["buffers"][0]["byteLength"]
    binary = bytes(document.binary or b"")[:start]
    return Document(document.path, root, memoryview(binary + b"\0" * (-start % 4) + data))


def _extend(
    character: Character, one: ExtendedBlock, root: dict[str, Any], writer: AppendedArrays, material: int
) -> None:
    document, block = character.document, character.blocks[one.block]
    where = f"meshes[{block.mesh}].primitives[{block.primitives[0]}]"
    mesh = root["meshes"][block.mesh]
    first = mesh["primitives"][block.primitives[0]]
    count = block.rows.stop - block.rows.start
    old = {
        name: read_floats(document, index, f"{where}.{name}", _TYPES, count)
        for name, index in document.record(first.get("attributes"), where).items()
    }
    if one.parts is not None and "TEXCOORD_0" not in old:
        old["TEXCOORD_0"] = np.zeros((count, 2), np.float32)
    own, normals = _in_the_array(character, block, one, old["POSITION"])
    attributes = {}
    joints = _joints(old, one.shares)
    for name, rows in old.items():
        new = joints[name] if name in joints else one.shares @ rows.astype(np.float64)
        if name == "POSITION":
            new = own
        elif name == "NORMAL":
            given = ~np.isnan(one.uvs[:, :1])
            new = np.where(given, normals, new / np.linalg.norm(new, axis=1, keepdims=True).clip(1e-12))
        elif name == "TEXCOORD_0":
            flipped = np.stack([one.uvs[:, 0], 1 - one.uvs[:, 1]], 1)
            new = np.where(np.isnan(one.uvs), new, flipped)
        elif name.startswith("COLOR"):
            new = np.where(np.isnan(one.uvs[:, :1]), new, 1.0)
        both = np.concatenate([rows, new.astype(np.float32)])
        attributes[name] = writer.joints(both) if name.startswith("JOINTS") else writer.vertices(both)
    targets = []
    for number, row in enumerate(document.array(first, "targets", where)):
        read = {
            name: read_floats(document, index, f"{where}.targets", _TYPES, count)
            for name, index in document.record(row, where).items()
        }
        if number in one.moves:
            read.setdefault("POSITION", np.zeros((count, 3), np.float32))
        target = {}
        for name, rows in read.items():
            new = one.shares @ rows
            if name == "POSITION" and number in one.moves:
                new = np.where(np.isnan(one.moves[number]), new, one.moves[number])
            target[name] = writer.deltas(np.concatenate([rows, new.astype(np.float32)]))
        targets.append(target)
    mirrored = np.linalg.det(character.linear[block.rows.start].numpy()) < 0
    for number in block.primitives:
        primitive = mesh["primitives"][number]
        faces = one.faces[number][:, ::-1] if mirrored else one.faces[number]
        primitive |= {"attributes": attributes, "indices": writer.triangles(faces)}
        primitive.pop("mode", None)
        if targets:
            primitive["targets"] = targets
    if one.parts is not None:
        added = {"attributes": attributes, "indices": writer.triangles(one.parts), "material": material}
        mesh["primitives"].append({**added, "targets": targets} if targets else added)


def _in_the_array(
    character: Character, block: Block, one: ExtendedBlock, positions: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """New places and normals in the array's own axes: back by what moves the vertices that each is a share of."""
    linear = character.linear[block.rows].numpy()
    shift = character.vertices[block.rows].numpy() - np.einsum("cij,cj->ci", linear, positions.astype(np.float64))
    matrix = (one.shares @ linear.reshape(len(linear), 9)).reshape(-1, 3, 3)
    own = np.linalg.solve(matrix, (one.places - one.shares @ shift)[..., None])[..., 0]
    normals = np.einsum("nji,nj->ni", matrix, one.normals)
    return own, normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)


def _joints(old: Mapping[str, NDArray[np.float32]], shares: sparse.csr_array) -> dict[str, NDArray[np.float64]]:
    """The joints and weights of new vertices: of those they are shares of the four that count most."""
    sets = [name[7:] for name in old if name.startswith("JOINTS_") and f"WEIGHTS_{name[7:]}" in old]
    if not sets:
        return {}
    count, joints = shares.shape[1], int(max(old[f"JOINTS_{one}"].max() for one in sets)) + 1
    total = sparse.csr_array((count, joints))
    for one in sets:
        ids, weights = old[f"JOINTS_{one}"].astype(np.int64), old[f"WEIGHTS_{one}"].astype(np.float64)
        row = np.repeat(np.arange(count), 4)
        total = total + sparse.csr_array((weights.ravel(), (row, ids.ravel())), shape=(count, joints))
    mixed = (shares @ total).toarray()
    mixed = np.pad(mixed, ((0, 0), (0, max(0, 4 - joints))))
    most = np.argsort(-mixed, axis=1, kind="stable")[:, :4]
    weight = np.take_along_axis(mixed, most, 1)
    weight /= weight.sum(1, keepdims=True).clip(1e-12)
    found = {f"{name}_{one}": np.zeros((len(mixed), 4)) for one in sets for name in ("JOINTS", "WEIGHTS")}
    found[f"JOINTS_{sets[0]}"], found[f"WEIGHTS_{sets[0]}"] = np.where(weight > 0, most, 0), weight
    return found
