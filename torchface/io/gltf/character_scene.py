"""The meshes of a character in a glTF file as they stand at rest, and the way back to the file's arrays."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.color_space import to_srgb
from torchface.errors import FileFormatError, TorchfaceError
from torchface.io.gltf.accessors import read_floats
from torchface.io.gltf.character_nodes import vrm_bones
from torchface.io.gltf.gltf_document import DRACO, Document
from torchface.io.gltf.gltf_reading import image_bytes
from torchface.io.gltf.primitive_reading import (
    BYTES_A_CORNER,
    BYTES_A_VERTEX,
    read_positions,
    read_target_names,
    read_triangles,
    read_uvs,
)
from torchface.io.gltf.rest_of_skin import blended, skin_matrices
from torchface.io.gltf.scene import node_transforms
from torchface.io.images.image_samples import decode_samples

_TRIANGLES = (4, 5, 6)
_HEAD_BONE = re.compile(r"(^|[^a-z])head$|^head(?!.*(end|top|nub))[^a-z]|[a-z]Head$", re.IGNORECASE)
_NO_HEAD_BONE = re.compile(r"fore|over|end$|top|nub|_end|target|ik", re.IGNORECASE)
_MAX_TEXTURE = 2**24  # texels; larger ones are drawn plain


@dataclass(frozen=True, eq=False)
class Block:
    """Vertices that some primitives of one mesh share."""

    node: int
    mesh: int
    primitives: tuple[int, ...]  # of the mesh, which share the vertices
    name: str  # the node's and the mesh's, for people and for rules by name
    materials: tuple[str, ...]
    rows: slice  # where the vertices lie among the character's
    names: tuple[str, ...]
    triangles: tuple[int, ...]  # how many each primitive has


@dataclass(frozen=True, eq=False)
class Character:
    """A scene's triangles at rest, V vertices split as the file has them, in the file's unit.

    Args:
        document: the file.
        vertices: (V,3) float64.
        linear: what moves directions from each vertex's array to the scene, (V,3,3) float64.
        faces: (F,3) int64, the way round that they have in the scene: turned where a node mirrors them.
        uvs: (V,2), origin at the lower left.
        material: which colour and texture each triangle has, (F,).
        colors: (M,4) red, green, blue, opacity, encoded as images are.
        textures: M images (4,H,W), none where there is none or it cannot be read.
        block: which block each vertex is of, (V,).
        blocks: all.
        head: how much of each vertex follows the head's bone, (V,) in [0,1]; none where no bone is known as one.
        head_bone: its name.
    """

    document: Document
    vertices: Tensor
    linear: Tensor
    faces: Tensor
    uvs: Tensor
    material: Tensor
    colors: Tensor
    textures: tuple[Tensor | None, ...]
    block: Tensor
    blocks: tuple[Block, ...]
    head: Tensor | None
    head_bone: str
    _read: dict[Block, Tensor] = field(default_factory=dict, repr=False)  # targets, which count once in the budget

    @property
    def first_triangles(self) -> list[int]:
        """The row of each block's first triangle among ``faces``."""
        return [0, *np.cumsum([sum(block.triangles) for block in self.blocks])[:-1].tolist()]

    def targets(self, block: Block) -> Tensor:
        """The morph targets (N,C,3) of a block's own array."""
        if block in self._read:
            return self._read[block]
        document, location = self.document, f"meshes[{block.mesh}].primitives[{block.primitives[0]}]"
        mesh = document.item("meshes", block.mesh, location)
        primitive = document.record(document.array(mesh, "primitives", location)[block.primitives[0]], location)
        count = block.rows.stop - block.rows.start
        deltas = torch.zeros(len(block.names), count, 3)
        for i, row in enumerate(document.array(primitive, "targets", location)[: len(deltas)]):
            target = document.record(row, f"{location}.targets[{i}]")
            if "POSITION" in target:
                rows = read_floats(document, target["POSITION"], f"{location}.targets[{i}]", ("VEC3",), count)
                deltas[i] = torch.from_numpy(rows)
        self._read[block] = deltas
        return deltas


def read_character(document: Document) -> Character:
    """The character in a glTF document."""
    transforms = node_transforms(document)
    bone = _head_bone(document, transforms)
    under = _descendants(document, bone) if bone is not None else set()
    shelf = _Shelf(document)
    for node, transform in transforms.items():
        record = document.item("nodes", node, "nodes")
        if record.get("mesh") is None:
            continue
        for mesh, group in _groups(document, record["mesh"], f"nodes[{node}].mesh"):
            shelf.add(node, mesh, group, transform, transforms, under)
    if not shelf.blocks or not sum(map(len, shelf.faces)):
        raise FileFormatError(f"{document.path}: found no triangle in its scene, expected a character's mesh")
    head = torch.from_numpy(np.concatenate(shelf.head)).double()
    return Character(
        document,
        torch.from_numpy(np.concatenate(shelf.vertices)),
        torch.from_numpy(np.concatenate(shelf.linear)),
        torch.from_numpy(np.concatenate(shelf.faces)),
        torch.from_numpy(np.concatenate(shelf.uvs)),
        torch.from_numpy(np.concatenate(shelf.material)),
        torch.stack(shelf.colors),
        tuple(shelf.textures),
        torch.repeat_interleave(
            torch.arange(len(shelf.blocks)), torch.tensor([b.rows.stop - b.rows.start for b in shelf.blocks])
        ),
        tuple(shelf.blocks),
        head if bool((head > 0).any()) else None,
        "" if bone is None else str(document.item("nodes", bone, "nodes").get("name", f"node {bone}")),
    )


def _groups(document: Document, index: int, where: str) -> Iterator[tuple[int, list[tuple[int, dict[str, Any]]]]]:
    """The primitives of triangles of a mesh, those that share their vertices together."""
    mesh = document.item("meshes", index, where)
    groups: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for i, row in enumerate(document.array(mesh, "primitives", f"meshes[{index}]")):
        primitive = document.record(row, f"meshes[{index}].primitives[{i}]")
        if primitive.get("mode", 4) in _TRIANGLES:
            key = json.dumps([primitive.get("attributes"), primitive.get("targets")], sort_keys=True)
            groups.setdefault(key, []).append((i, primitive))
    for group in groups.values():
        yield index, group


class _Shelf:
    """Arrays of the blocks read so far."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.blocks: list[Block] = []
        self.vertices: list[NDArray[np.float64]] = []
        self.linear: list[NDArray[np.float64]] = []
        self.uvs: list[NDArray[np.float32]] = []
        self.head: list[NDArray[np.float32]] = []
        self.faces: list[NDArray[np.int64]] = []
        self.material: list[NDArray[np.int64]] = []
        self.colors: list[Tensor] = []
        self.textures: list[Tensor | None] = []
        self._rows: dict[object, int] = {}
        self._images: dict[int, Tensor | None] = {}
        self._count = 0

    def add(
        self,
        node: int,
        mesh: int,
        group: list[tuple[int, dict[str, Any]]],
        transform: NDArray[np.float64],
        transforms: dict[int, NDArray[np.float64]],
        under: set[int],
    ) -> None:
        document, location = self.document, f"meshes[{mesh}].primitives[{group[0][0]}]"
        if DRACO in document.record(group[0][1].get("extensions"), f"{location}.extensions"):
            plain = (
                "plain data, to which shapes can be added; decompress it: npx @gltf-transform/cli copy IN.glb OUT.glb"
            )
            raise document.error(location, "Draco compression", plain)
        attributes, positions = read_positions(document, group[0][1], location)
        count = len(positions)
        document.reserve(count * (BYTES_A_VERTEX + 16 * 8), f"{location}.POSITION")
        record = document.item("nodes", node, "nodes")
        if record.get("skin") is not None and "JOINTS_0" in attributes:
            joints, moved = skin_matrices(document, record["skin"], transforms)
            of_head = np.array([joint in under for joint in joints], np.float64)
            matrices = blended(document, moved, attributes, location, count)
            matrices[np.isnan(matrices).any((1, 2))] = np.eye(4)
            head = np.nan_to_num(blended(document, of_head, attributes, location, count)).astype(np.float32)
        else:
            matrices, head = np.broadcast_to(transform, (count, 4, 4)), np.full(count, node in under, np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            placed = np.einsum("cij,cj->ci", matrices[:, :3, :3], positions.astype(np.float64)) + matrices[:, :3, 3]
        if not np.isfinite(placed).all():
            raise document.error(location, "positions that overflow", "finite numbers")
        uvs = np.zeros((count, 2), np.float32)
        for number, primitive in group:
            faces = read_triangles(document, primitive, f"meshes[{mesh}].primitives[{number}]", count)
            document.reserve(faces.size * BYTES_A_CORNER, location)
            material, texture = self._material(primitive, f"meshes[{mesh}].primitives[{number}].material")
            if (found := read_uvs(document, attributes, texture, location, count)) is not None:
                own = np.unique(faces)  # other materials may place their textures otherwise
                uvs[own] = found[own]
            mirrored = np.linalg.det(matrices[faces[:, 0], :3, :3]) < 0
            self.faces.append(np.where(mirrored[:, None], faces[:, ::-1], faces) + self._count)
            self.material.append(np.full(len(faces), material))
        names = read_target_names(document, mesh)
        materials = [document.item("materials", p["material"], location) for _, p in group if "material" in p]
        self.blocks.append(
            Block(
                node,
                mesh,
                tuple(number for number, _ in group),
                " ".join(str(x.get("name", "")) for x in (record, document.item("meshes", mesh, location))).strip(),
                tuple(str(material.get("name", "")) for material in materials),
                slice(self._count, self._count + count),
                names,
                tuple(len(faces) for faces in self.faces[-len(group) :]),
            )
        )
        self.vertices.append(placed)
        self.linear.append(np.ascontiguousarray(matrices[:, :3, :3]))
        self.uvs.append(uvs)
        self.head.append(head)
        self._count += count

    def _material(self, primitive: dict[str, Any], where: str) -> tuple[int, dict[str, Any]]:
        """The row of a primitive's colour and texture, and what the material says of the texture."""
        document, key = self.document, primitive.get("material")
        material = {} if key is None else document.item("materials", key, where)
        surface = document.record(material.get("pbrMetallicRoughness"), where)
        texture = document.record(surface.get("baseColorTexture"), where)
        if key not in self._rows:
            factor = document.numbers(surface, "baseColorFactor", where, 4) or [1.0, 1.0, 1.0, 1.0]
            color = torch.tensor(factor).clamp(0, 1)
            color[:3] = to_srgb(color[:3])
            image = self._image(texture["index"]) if "index" in texture else None
            if material.get("alphaMode", "OPAQUE") == "OPAQUE":
                color[3] = 1
                image = None if image is None else torch.cat([image[:3], torch.ones_like(image[:1])])
            self._rows[key] = len(self.colors)
            self.colors.append(color)
            self.textures.append(image)
        return self._rows[key], texture

    def _image(self, index: object) -> Tensor | None:
        """The image of a texture; none where it is of a kind that is not read."""
        found = image_bytes(self.document, index)
        if found is None:
            return None
        data, source = found
        if source not in self._images:
            try:
                paint = decode_samples(bytes(data), f"{self.document.path}: images[{source}]", planes=4).paint()
            except TorchfaceError:
                self._images[source] = None  # it is kept as it is; the face is looked for in clay
            else:
                self._images[source] = paint if paint[0].numel() <= _MAX_TEXTURE else None
        return self._images[source]


def _head_bone(document: Document, transforms: dict[int, NDArray[np.float64]]) -> int | None:
    """The node of the head: what VRM says, else the joint or node of such a name that is nearest to the root."""
    bone = vrm_bones(document).get("head")
    if isinstance(bone, int) and bone in transforms:
        return bone
    nodes = document.objects("nodes")
    lists = [document.array(skin, "joints", "skins") for skin in document.objects("skins")]
    joints = {joint for row in lists for joint in row if isinstance(joint, int)}
    for candidates in (sorted(joints & set(transforms)), sorted(transforms)):
        for node in candidates:
            name = str(nodes[node].get("name", ""))
            if _HEAD_BONE.search(name) and not _NO_HEAD_BONE.search(name) and nodes[node].get("mesh") is None:
                return node
    return None


def _descendants(document: Document, root: int) -> set[int]:
    found, pending = {root}, [root]
    while pending:
        for child in document.array(document.item("nodes", pending.pop(), "nodes"), "children", "nodes"):
            if child not in found:
                found.add(child)
                pending.append(child)
    return found
