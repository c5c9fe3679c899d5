"""The meshes that a scene shows, each with the transform of its node."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchface.geometry.rotations import quaternion_matrix
from torchface.io.gltf.gltf_document import Document

_MAX_INSTANCES = 4096


@dataclass(frozen=True)
class Instance:
    """A mesh in the scene."""

    mesh: int  # its index among the document's meshes
    name: str  # the node's name, else the mesh's, else mesh_0 and so on
    transform: NDArray[np.float64]  # from mesh to scene, (4,4); of a skinned mesh none
    skin: int | None = None


def instances(document: Document) -> list[Instance]:
    """What the default scene shows; without a scene all root nodes, without nodes all meshes.

    A skinned mesh stands where its skeleton's rest pose puts it (``rest_of_skin``), so its node does not move it.
    """
    meshes = document.objects("meshes")
    nodes = document.objects("nodes")
    if not nodes:
        return [Instance(i, _name(mesh, {}, i), np.eye(4)) for i, mesh in enumerate(meshes[:_MAX_INSTANCES])]
    visible = []
    for index, transform in _walk(document, nodes):
        node, location = nodes[index], f"nodes[{index}]"
        if node.get("mesh") is None:
            continue
        mesh = document.item("meshes", node["mesh"], f"{location}.mesh")
        skin = node.get("skin")
        placed = transform if skin is None else np.eye(4)
        visible.append(Instance(node["mesh"], _name(node, mesh, node["mesh"]), placed, skin))
        if len(visible) > _MAX_INSTANCES:
            raise document.error("nodes", f"more than {_MAX_INSTANCES} meshes in the scene", "a rig")
    return visible


def node_transforms(document: Document) -> dict[int, NDArray[np.float64]]:
    """From each node of the default scene to the scene, (4,4)."""
    return dict(_walk(document, document.objects("nodes")))


def local_transform(document: Document, node: int) -> NDArray[np.float64]:
    """From a node to its parent, (4,4)."""
    return _local(document, document.item("nodes", node, "nodes"), f"nodes[{node}]")


def _name(first: dict[str, Any], second: dict[str, Any], index: int) -> str:
    names = [name for thing in (first, second) if isinstance(name := thing.get("name"), str) and name]
    return names[0] if names else f"mesh_{index}"


def _walk(document: Document, nodes: list[dict[str, Any]]) -> Iterator[tuple[int, NDArray[np.float64]]]:
    pending = [(root, np.eye(4)) for root in reversed(_roots(document, nodes))]
    visited: set[int] = set()
    while pending:
        index, parent = pending.pop()
        node = document.item("nodes", index, "nodes")
        if index in visited:
            raise document.error(f"nodes[{index}]", "a cycle or a second parent", "a tree of nodes")
        visited.add(index)
        with np.errstate(over="ignore", invalid="ignore"):
            transform = parent @ _local(document, node, f"nodes[{index}]")
        if not np.isfinite(transform).all():
            raise document.error(f"nodes[{index}]", "a transform that overflows", "finite numbers")
        yield index, transform
        pending += [(child, transform) for child in reversed(document.array(node, "children", f"nodes[{index}]"))]


def _roots(document: Document, nodes: list[dict[str, Any]]) -> list[Any]:
    scenes = document.objects("scenes")
    if scenes:
        scene = document.item("scenes", document.root.get("scene", 0), "scene")
        return document.array(scene, "nodes", "scene")
    lists = [document.array(node, "children", f"nodes[{i}]") for i, node in enumerate(nodes)]
    children = {child for row in lists for child in row if isinstance(child, int)}
    roots = [i for i in range(len(nodes)) if i not in children]
    if not roots:
        raise document.error("nodes", "a cycle", "a tree of nodes")
    return roots


def _local(document: Document, node: dict[str, Any], location: str) -> NDArray[np.float64]:
    matrix = document.numbers(node, "matrix", location, 16)
    if matrix is not None:
        transform = np.array(matrix).reshape(4, 4).T  # column by column in the file
        if not np.allclose(transform[3], (0, 0, 0, 1)):
            raise document.error(f"{location}.matrix", transform[3].tolist(), "a last row of 0, 0, 0, 1")
        return transform
    x, y, z, w = document.numbers(node, "rotation", location, 4) or (0.0, 0.0, 0.0, 1.0)
    length = np.sqrt(x * x + y * y + z * z + w * w)
    if not 0.5 < length < 2:
        raise document.error(f"{location}.rotation", [x, y, z, w], "a unit quaternion")
    transform = np.eye(4)
    transform[:3, :3] = quaternion_matrix(torch.tensor([x, y, z, w], dtype=torch.float64) / length).numpy()
    transform[:3, :3] *= document.numbers(node, "scale", location, 3) or (1.0, 1.0, 1.0)
    transform[:3, 3] = document.numbers(node, "translation", location, 3) or (0.0, 0.0, 0.0)
    return transform
