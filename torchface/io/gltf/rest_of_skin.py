"""Where a skin puts a mesh's vertices while its joints are at rest."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchface.io.gltf.accessors import read_floats
from torchface.io.gltf.gltf_document import Document
from torchface.io.gltf.primitive_reading import BYTES_A_VERTEX, Part
from torchface.io.gltf.scene import Instance, node_transforms

_BOUND = 1e-4  # of a mesh's size: a rest pose that is nearer to the pose of binding is that one


def skin_matrices(
    document: Document, index: object, transforms: dict[int, NDArray[np.float64]]
) -> tuple[list[int], NDArray[np.float64]]:
    """The joints of a skin, and what each does to vertices at rest, (J,4,4) from the mesh to the scene."""
    skin, where = document.item("skins", index, "skin"), f"skins[{index}]"
    joints = document.array(skin, "joints", where)
    if not joints or any(not isinstance(joint, int) or joint not in transforms for joint in joints):
        raise document.error(f"{where}.joints", "a joint outside of the scene", "nodes of the scene")
    binds = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    if skin.get("inverseBindMatrices") is not None:
        rows = read_floats(document, skin["inverseBindMatrices"], where, ("MAT4",))
        if len(rows) < len(joints):
            raise document.error(f"{where}.inverseBindMatrices", len(rows), f"one for each of {len(joints)} joints")
        binds = rows[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)
    return joints, np.stack([transforms[joint] for joint in joints]) @ binds


def blended(
    document: Document, matrices: NDArray[np.float64], attributes: dict[str, Any], location: str, count: int
) -> NDArray[np.float64]:
    """Rows of numbers of a skin's joints, (J,...), blended by each vertex's weights, (C,...); NaN where it has none."""
    sums, total = np.zeros((count, *matrices.shape[1:])), np.zeros(count)
    beside = (count,) + (1,) * (matrices.ndim - 1)
    for number in range(4):  # sets of four joints a vertex
        if f"JOINTS_{number}" not in attributes or f"WEIGHTS_{number}" not in attributes:
            break
        ids = read_floats(document, attributes[f"JOINTS_{number}"], f"{location}.JOINTS_{number}", ("VEC4",), count)
        weights = read_floats(document, attributes[f"WEIGHTS_{number}"], f"{location}.WEIGHTS", ("VEC4",), count)
        if count and not 0 <= ids.min() <= ids.max() < len(matrices):
            raise document.error(f"{location}.JOINTS_{number}", int(ids.max()), f"less than the {len(matrices)} joints")
        for column in range(4):
            sums += weights[:, column].reshape(beside) * matrices[ids[:, column].astype(np.int64)]
            total += weights[:, column]
    bound = total >= 1e-6
    return np.where(bound.reshape(beside), sums / np.where(bound, total, 1.0).reshape(beside), np.nan)


def at_rest(document: Document, instance: Instance, part: Part) -> Part:
    """A skinned mesh where its joints put it at rest; as it was bound where they do so or the scene lacks them."""
    if instance.skin is None:
        return part
    transforms = node_transforms(document)
    joints = document.array(document.item("skins", instance.skin, "skin"), "joints", f"skins[{instance.skin}]")
    if not joints or any(joint not in transforms for joint in joints if isinstance(joint, int)):
        return part
    _, matrices = skin_matrices(document, instance.skin, transforms)
    away = np.abs(matrices - np.eye(4))
    if away[:, :3, :3].max() <= _BOUND and away[:, :3, 3].max() <= _BOUND * np.abs(part.positions).max():
        return part
    location = f"meshes[{instance.mesh}]"
    document.reserve(part.deltas.nbytes + len(part.positions) * (BYTES_A_VERTEX + 16 * 8), f"skins[{instance.skin}]")
    rows = [blended(document, matrices, attributes, location, count) for attributes, count in part.attributes]
    placed = np.concatenate(rows)
    placed[np.isnan(placed).any((1, 2))] = np.eye(4)
    linear = placed[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        positions = np.einsum("cij,cj->ci", linear, part.positions) + placed[:, :3, 3]
        deltas = [np.einsum("cij,cj->ci", linear, delta).astype(np.float32) for delta in part.deltas]
    return replace(
        part,
        positions=positions.astype(np.float32),
        deltas=np.stack(deltas) if deltas else part.deltas,
    )
