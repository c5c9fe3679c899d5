"""A glTF scene as one rig: all its meshes put together, shapes of the same name joined."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.color_space import to_srgb
from torchface.errors import FileFormatError, MissingExtraError
from torchface.geometry.meshes.uv_seams import merge_equal_rows
from torchface.io.gltf.corrective_extras import rig_of_targets, scene_correctives
from torchface.io.gltf.gltf_document import Document, read_document
from torchface.io.gltf.mesh_extras import (
    is_own_mesh,
    read_annotations,
    read_mesh_count,
    read_order,
    read_polygons,
    read_row_annotations,
)
from torchface.io.gltf.primitive_reading import BYTES_A_CORNER, BYTES_A_VERTEX, MaterialLook, Part, filled, read_part
from torchface.io.gltf.rest_of_skin import at_rest
from torchface.io.gltf.scene import Instance, instances
from torchface.io.images.image_files import decode_image
from torchface.io.images.ktx2_images import is_ktx2, ktx2_reader
from torchface.io.images.texture_atlas import Look, with_used_looks
from torchface.io.length_units import millimetres_per
from torchface.io.scenes.missing_shapes import no_shapes, no_target
from torchface.io.scenes.scene_pieces import Piece, all_names, join_deltas, join_meshes, joined_size
from torchface.mesh import Annotations, Mesh
from torchface.rig import BlendshapeRig

_AT_ONCE = 2**20  # numbers
_STIR = np.uint64(0x9E3779B97F4A7C15)
_STIRRED_AT_ONCE = 2**18


def read_gltf_rig(path: str | Path, unit: str = "m") -> BlendshapeRig:
    """The rig in a glTF file: every mesh of the scene, moved by its node, morph targets joined by name.

    Names come from ``mesh.extras.targetNames``, where Blender and three.js write and look for them; without they are
    ``target_0`` and so on; those that the file calls correctives become those. A scene of several meshes gets a region
    a node. Vertices split at seams become one again.
    """
    document = read_document(path)
    neutral, deltas, names = _read(document, millimetres_per(unit))
    if not names:
        raise no_shapes(path, no_target(len(document.objects("meshes"))))
    return rig_of_targets(document, neutral, deltas, names, scene_correctives(document))


def read_gltf_mesh(path: str | Path, unit: str = "m") -> Mesh:
    """The scene of a glTF file as one mesh, morph targets at rest; see ``read_gltf_rig``."""
    return _read(read_document(path), millimetres_per(unit))[0]


def _read(document: Document, scale: float) -> tuple[Mesh, Tensor, tuple[str, ...]]:
    parts: dict[int, Part | None] = {}
    instanced: list[tuple[Instance, Part]] = []
    for instance in instances(document):
        if instance.mesh not in parts:
            parts[instance.mesh] = read_part(document, instance.mesh)
        part = parts[instance.mesh]
        if part is not None and len(part.triangles):
            size = part.deltas.nbytes + BYTES_A_VERTEX * len(part.positions) + BYTES_A_CORNER * part.triangles.size
            document.reserve(size, f"nodes: {instance.name[:40]}")
            instanced.append((instance, at_rest(document, instance, part)))
    if not instanced:
        raise FileFormatError(f"{document.path}: found no triangle in its scene, expected a mesh")
    whole = rejoined(document, instanced)
    kinds = list(dict.fromkeys(kind for _, part in instanced for kind, _ in part.looks))
    made = [_piece(document, instance, part, scale, kinds) for instance, part in ([whole] if whole else instanced)]
    pieces = [piece for piece, _ in made]
    look = torch.cat([one for _, one in made])
    ours = any(is_own_mesh(part.extras.get("torchface")) for _, part in instanced)
    del parts, instanced, part, whole, made  # their shapes fit the memory once, not twice
    document.reserve(joined_size(pieces), "the scene's morph targets")
    mesh = join_meshes(pieces, None)
    return _with_looks(document, mesh, look, kinds, ours), join_deltas(pieces), all_names(pieces)


def _with_looks(document: Document, mesh: Mesh, look: Tensor, kinds: list[MaterialLook], ours: bool) -> Mesh:
    """The mesh with the images and colours of its materials as its one texture; ``look`` (F,) says whose each is.

    Plain colours of files that torchface wrote are those of parts that regions name, and vertex colours are of meshes
    without images: these stay without a place in the texture.
    """
    images: dict[int | None, Tensor | None] = {None: None}
    for kind in kinds:
        if kind.texture is not None and kind.texture not in images:
            images[kind.texture] = image = read_texture(document, kind.texture)
            document.reserve(0 if image is None else 12 * image[0].numel(), f"textures[{kind.texture}]")
    looks = [Look(images[kind.texture], to_srgb(torch.tensor(kind.color).clamp(0, 1))) for kind in kinds]
    return with_used_looks(mesh, look, looks, images_only=ours or mesh.colors is not None)


def _piece(
    document: Document, instance: Instance, part: Part, scale: float, kinds: list[MaterialLook]
) -> tuple[Piece, Tensor]:
    """The mesh in its place, and which of the kinds of look each of its triangles has, (F,)."""
    location = f"meshes[{instance.mesh}].extras.torchface"
    joined = weld(part)
    linear, translation = instance.transform[:3, :3] * scale, instance.transform[:3, 3] * scale
    vertices = _moved(part.positions[joined.row_of], linear, translation)
    deltas = np.zeros((len(part.deltas), len(vertices), 3), np.float32)
    blocks = 1 + part.deltas.size // _AT_ONCE
    for some, given in zip(np.array_split(deltas, blocks), np.array_split(part.deltas, blocks), strict=True):
        some[:] = _moved(given[:, joined.row_of], linear)
    if not np.isfinite(vertices).all() or not np.isfinite(deltas).all():
        raise document.error(f"meshes[{instance.mesh}]", "positions that overflow", "finite millimetres")
    extras, triangles = part.extras.get("torchface"), part.triangles
    row = {kind: number for number, kind in enumerate(kinds)}
    look = np.repeat([row[kind] for kind, _ in part.looks], [count for _, count in part.looks])
    rows = read_order(document, extras, location, len(triangles)) if joined.authored else None
    if rows is not None:
        triangles = np.empty_like(triangles)
        triangles[rows] = part.triangles
        look[rows] = look.copy()
    faces = joined.vertex_of[triangles]
    uvs = uv_faces = None
    if part.uvs is not None:
        uvs, uv_faces = _texture_coordinates(part.uvs, joined.vertex_of, triangles)
    piece = Piece(
        instance.name,
        torch.from_numpy(vertices),
        torch.from_numpy(np.ascontiguousarray(faces)),
        uvs,
        uv_faces,
        None if part.colors is None else torch.from_numpy(part.colors[joined.row_of]),
        read_polygons(document, extras, location, faces),
        _annotations(document, part, location, vertices.astype(np.float64) / scale, joined),
        torch.from_numpy(deltas),
        part.names,
    )
    return piece, torch.from_numpy(look)


def _texture_coordinates(
    uvs: NDArray[np.float32], vertex_of: NDArray[np.int64], triangles: NDArray[np.int64]
) -> tuple[Tensor, Tensor]:
    """Each pair of vertex and coordinate once: what was split at the border of two primitives is no seam."""
    used = np.unique(triangles)
    keys = np.column_stack([vertex_of[used], (uvs[used] + np.float32(0)).view(np.int32)])
    row = np.zeros(len(uvs), np.int64)
    row[used], first = merge_equal_rows(keys)
    return torch.from_numpy(uvs[used][first]), torch.from_numpy(row[triangles])


def _moved(
    points: NDArray[np.float32], linear: NDArray[np.float64], translation: NDArray[np.float64] | float = 0.0
) -> NDArray[np.float32]:
    with np.errstate(over="ignore", invalid="ignore"):
        return (points @ linear.T + translation).astype(np.float32)


_IMAGE_EXTENSIONS = "EXT_texture_webp", "KHR_texture_basisu"


def image_bytes(document: Document, index: object) -> tuple[memoryview, int] | None:
    """The encoded image of a texture, a WebP or KTX2 of an extension too, and its number; None where it has none."""
    location = f"textures[{index}]"
    texture = document.item("textures", index, location)
    extensions = document.record(texture.get("extensions"), location)
    named = [document.record(extensions.get(name), location).get("source") for name in _IMAGE_EXTENSIONS]
    source = texture.get("source", next((one for one in named if one is not None), None))
    if source is None:
        return None
    image, location = document.item("images", source, f"{location}.source"), f"images[{source}]"
    if image.get("uri") is not None:
        return document.bytes_at(image["uri"], f"{location}.uri"), source
    return document.view(image.get("bufferView"), f"{location}.bufferView")[0], source


def unread_textures(path: str | Path) -> list[str]:
    """Why textures of a file cannot be read, a sentence for each of them."""
    document, found = read_document(path), list[str]()
    for row in range(len(document.objects("textures"))):
        image = image_bytes(document, row)
        if image is None:
            found.append("found none of a kind that is known, expected PNG, JPEG, WebP or KTX2")
        elif is_ktx2(image[0]):
            try:
                ktx2_reader(f"textures[{row}]")
            except MissingExtraError as error:
                found.append(str(error))
    return found


def read_texture(document: Document, index: int) -> Tensor | None:
    """The image of a texture; none, with a warning, where it is of a kind that is not read here."""
    found = image_bytes(document, index)
    try:
        return None if found is None else decode_image(bytes(found[0]), f"{document.path}: images[{found[1]}]")
    except MissingExtraError as error:
        warnings.warn(f"{error}; the surface goes without it", stacklevel=2)
        return None


def rejoined(document: Document, instanced: Sequence[tuple[Instance, Part]]) -> tuple[Instance, Part] | None:
    """The parts of a scene as one, in the scene's axes; none where they were not written as one."""
    first = instanced[0]
    location = f"meshes[{first[0].mesh}].extras.torchface"
    if read_mesh_count(document, first[1].extras.get("torchface"), location) != len(instanced) or len(instanced) == 1:
        return None
    parts = [part for _, part in instanced]
    if any(part.vertex_ids is None or part.names != first[1].names for part in parts):
        return None
    count = [len(part.positions) for part in parts]
    document.reserve(sum(part.deltas.nbytes + part.positions.nbytes for part in parts), "nodes")
    positions, deltas = [], []
    for instance, part in instanced:
        linear, translation = instance.transform[:3, :3], instance.transform[:3, 3]
        with np.errstate(over="ignore", invalid="ignore"):
            positions.append((part.positions @ linear.T + translation).astype(np.float32))
            deltas.append((part.deltas @ linear.T).astype(np.float32))
    starts = [0, *accumulate(count[:-1])]
    whole = Part(
        np.concatenate(positions),
        np.concatenate(deltas, axis=1),
        first[1].names,
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=True)]),
        filled([part.uvs for part in parts], count, 0.0),
        filled([part.colors for part in parts], count, 1.0),
        np.concatenate([part.vertex_ids for part in parts if part.vertex_ids is not None]),
        tuple(one for part in parts for one in part.looks),
        first[1].extras,
        (),
    )
    return replace(first[0], transform=np.eye(4)), whole


@dataclass(frozen=True)
class Weld:
    """Which split vertices are one."""

    vertex_of: NDArray[np.int64]  # for each split vertex the vertex it belongs to, (C,)
    row_of: NDArray[np.int64]  # for each vertex the first split one, (V,)
    authored: bool  # the numbering is the one the mesh was written with, so annotations hold


def weld(part: Part) -> Weld:
    """By the vertex ids in the file where they are consistent, else by equal position and equal deltas."""
    if part.vertex_ids is not None:
        welded = _by_id(part, part.vertex_ids)
        if welded is not None:
            return welded
    return _by_position(part)


def _annotations(
    document: Document, part: Part, location: str, vertices: NDArray[np.float64], joined: Weld
) -> Annotations | None:
    """Those of the mesh as it was written; without landmarks there, those of a character's rows."""
    extras = part.extras.get("torchface")
    own = read_annotations(document, extras, location, len(vertices)) if joined.authored else None
    if own is not None and own.landmarks is not None:
        return own
    once = _read_once(part)
    row_of = np.cumsum(once)[joined.row_of] - 1
    of_rows = read_row_annotations(document, extras, location, vertices, (joined.vertex_of[once], row_of))
    if own is None or of_rows is None:
        return of_rows or own
    return replace(own, landmarks=of_rows.landmarks, regions={**of_rows.regions, **own.regions})


def _read_once(part: Part) -> NDArray[np.bool_]:
    """The rows (C,) without those that were read a second time, for a material that places its texture otherwise."""
    seen, once = list[dict[str, Any]](), list[NDArray[np.bool_]]()
    for attributes, count in part.attributes:
        once.append(np.full(count, attributes not in seen))
        seen.append(attributes)
    return np.concatenate(once) if once else np.ones(len(part.positions), bool)


def _by_id(part: Part, ids: NDArray[np.int64]) -> Weld | None:
    """None where an id is missing or its split vertices lie apart, as when another program has edited the mesh."""
    present, row_of = np.unique(ids, return_index=True)
    if len(present) == 0 or int(present[-1]) != len(present) - 1:
        return None
    same = np.array_equal(part.positions, part.positions[row_of[ids]])
    same = same and all(np.array_equal(delta, delta[row_of[ids]]) for delta in part.deltas)
    return Weld(ids, row_of, True) if same else None


def _by_position(part: Part) -> Weld:
    """Vertices numbered by first appearance; lips that touch at rest stay apart because they move differently."""
    vertex_of, row_of = merge_equal_rows(_keys(part.positions[None]) + _keys(part.deltas))
    return Weld(vertex_of, row_of, False)


def _keys(tables: NDArray[np.float32]) -> NDArray[np.int64]:
    """Two numbers (C,2) for the rows of all tables (N,C,3), equal where all these are.

    Each is a sum of the rows' words, stirred and times odd numbers drawn by chance: no file can aim at two rows that
    have the same two keys and differ, and by chance they do once in 2^100.
    """
    generator = np.random.default_rng()
    count = tables.shape[1]
    keys = np.zeros((count, 2), np.uint64)
    for some in np.array_split(tables, 1 + tables.size // _STIRRED_AT_ONCE):  # all at once take three times the memory
        flat = (some + np.float32(0)).transpose(1, 0, 2).reshape(count, -1)  # -0 equals 0
        words = flat.view(np.uint32).astype(np.uint64) * _STIR
        words ^= words >> np.uint64(32)
        odd = generator.integers(2**63, size=(words.shape[1], 2), dtype=np.uint64) * np.uint64(2) + np.uint64(1)
        keys += words @ odd
    return keys.view(np.int64)
