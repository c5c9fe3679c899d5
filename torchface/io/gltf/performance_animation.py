"""A performance as the first animation of a character's own ``.glb``; all else in the file stays as it is."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from torchface.io.gltf.accessors import read_floats
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.character_nodes import character_nodes, looks_back
from torchface.io.gltf.draco_primitives import unpack_draco
from torchface.io.gltf.gltf_document import Document, glb_pieces
from torchface.io.gltf.primitive_reading import read_target_names
from torchface.io.gltf.rest_of_skin import blended
from torchface.io.gltf.scene import instances, local_transform, node_transforms
from torchface.shape_names import read_as_arkit

NECKS_SHARE = 0.3  # of the head's rotation, where there is a neck

_BOUND, _LEAST = 0.5, 0.05  # of an eye's vertices to its bone; of a shape's largest motion, that an eye looks by it
_PIVOT = (0.0, -0.25, -0.1)  # of the shapes' box from its middle: where a head without bones turns


@dataclass(frozen=True, eq=False)
class Performance:
    """Weights and rotations of a take."""

    seconds: NDArray[np.float64]  # of each frame, (T,)
    names: Sequence[str]
    weights: NDArray[np.float32]  # (T,N)
    # Live Link Face's yaw, pitch and roll of head, left and right eye, (T,9) radians; the head keeps its pose without
    rotations: NDArray[np.float64] | None = None
    fps: float | None = None  # kept beside the keys, whose times are rounded


def performed_glb(document: Document, performance: Performance) -> bytes:
    """The ``.glb`` with the performance: shapes by name, and head, neck and eyes where the character has them.

    A character without a bone for its head turns as a whole, about a node of its own.
    """
    root = copy.deepcopy(document.root)
    buffers = _appended(root, bytes(document.binary or b""))
    times = buffers.keys(performance.seconds[:, None].astype(np.float32), bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def drive(node: int, path: str, output: int) -> None:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})

    written: dict[tuple[object, ...], int] = {}
    for index, node in enumerate(document.objects("nodes")):
        if node.get("mesh") is None or not (names := read_target_names(document, node["mesh"])):
            continue
        rest = node.get("weights") or document.objects("meshes")[node["mesh"]].get("weights") or [0.0] * len(names)
        key = (names, *rest)  # meshes of one head share their keys
        if key not in written:
            written[key] = buffers.keys(_keys(names, rest, performance).reshape(-1, 1))
        drive(index, "weights", written[key])
    turns = [] if performance.rotations is None else _turned(document, root, performance.rotations)
    for node_index, turned in turns:
        quaternions = np.ascontiguousarray(turned.as_quat(), np.float32)
        drive(node_index, "rotation", buffers.keys(quaternions))
    animation: dict[str, Any] = {"name": "performance", "samplers": samplers, "channels": channels}
    if performance.fps is not None:
        animation["extras"] = {"torchface": {"fps": performance.fps}}
    root["animations"] = [animation, *root.get("animations", [])]  # programs that play one take the first
    return b"".join(glb_pieces(root, buffers, document.path))


def _appended(root: dict[str, Any], binary: bytes) -> BufferWriter:
    """What goes on behind a file's own data."""
    buffers = BufferWriter()
    padded = binary + b"\0" * (-len(binary) % 4)
    buffers.pieces, buffers.size = [padded], len(padded)
    buffers.views, buffers.accessors = root.get("bufferViews", []), root.get("accessors", [])
    return buffers


def _keys(names: Sequence[str], rest: Sequence[float], performance: Performance) -> NDArray[np.float32]:
    keys = np.tile(np.asarray(rest, np.float32), (len(performance.seconds), 1))
    columns = {name: column for column, name in enumerate(performance.names)}
    for place, name in enumerate(names):
        if name in columns:
            keys[:, place] = performance.weights[:, columns[name]]
    return keys


def _turned(document: Document, root: dict[str, Any], rotations: NDArray[np.float64]) -> list[tuple[int, Rotation]]:
    """Nodes, and how each is rotated beside its parent in every frame, (T,)."""
    head, left, right = (rotations[:, 3 * i : 3 * i + 3] for i in range(3))
    whole = Rotation.from_euler("YXZ", head)
    parts, found = character_nodes(document), list[tuple[int, Rotation]]()
    transforms, nodes = node_transforms(document), document.objects("nodes")
    parents = {child: i for i in transforms for child in document.array(nodes[i], "children", f"nodes[{i}]")}
    back = Rotation.from_euler("Y", np.pi if looks_back(document) else 0.0)

    def add(part: str, turn: Rotation) -> None:
        node = parts[part]
        parent = parents.get(node)
        above = back * (Rotation.identity() if parent is None else _rotation(transforms[parent]))
        found.append((node, above.inv() * turn * above * _rotation(local_transform(document, node))))
        _without_matrix(document, root, node)

    parts = {part: node for part, node in parts.items() if node in transforms}
    if "head" in parts:
        share = NECKS_SHARE if "neck" in parts else 0.0
        if share:
            add("neck", Rotation.from_rotvec(share * whole.as_rotvec()))
        add("head", Rotation.from_rotvec((1 - share) * whole.as_rotvec()))
    for part, angles in (("rightEye", right), ("leftEye", left)):
        if part in parts and not _looks_by_shapes(document, parts[part]):
            # Live Link Face counts eyes to the person's right and down.
            turn = Rotation.from_euler("YX", np.stack([-angles[:, 0], angles[:, 1]], 1))
            add(part, turn)
    if "head" not in parts:
        found.append((_hung_up(document, root), back.inv() * whole * back))
    return found


def _rotation(transform: NDArray[np.float64]) -> Rotation:
    columns = transform[:3, :3]
    return Rotation.from_matrix(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-12))


def _without_matrix(document: Document, root: dict[str, Any], node: int) -> None:
    """Only nodes with translation, rotation and scale may be animated."""
    fields = root["nodes"][node]
    if fields.pop("matrix", None) is not None:
        transform = local_transform(document, node)
        fields["translation"] = transform[:3, 3].tolist()
        fields["rotation"] = _rotation(transform).as_quat().tolist()
        fields["scale"] = np.linalg.norm(transform[:3, :3], axis=0).tolist()


def _looks_by_shapes(document: Document, node: int) -> bool:
    """Whether an eye is moved by looking shapes, of its own mesh or of one whose skin binds it to the node, so that
    turning it would move it twice."""
    nodes = document.objects("nodes")
    own = (node, *document.array(nodes[node], "children", f"nodes[{node}]"))
    for index, one in enumerate(nodes):
        if (mesh := one.get("mesh")) is None:
            continue
        skin = {} if one.get("skin") is None else document.item("skins", one["skin"], "skin")
        joints = np.array(document.array(skin, "joints", "skins")) == node
        if index not in own and not joints.any():
            continue
        names = read_as_arkit(read_target_names(document, mesh))
        for primitive in document.array(document.objects("meshes")[mesh], "primitives", "mesh"):
            unpack_draco(document, primitive, "mesh")
            for name, target in zip(names, primitive.get("targets", []), strict=False):
                if not name.lower().startswith("eyelook") or "POSITION" not in target:
                    continue
                moved = np.abs(read_floats(document, target["POSITION"], "targets", ("VEC3",))).max(1)
                attributes = primitive["attributes"]
                bound = index in own or blended(document, joints, attributes, "mesh", len(moved)) > _BOUND
                if (moved * bound).max(initial=0.0) > _LEAST * moved.max(initial=0.0):
                    return True
    return False


def _hung_up(document: Document, root: dict[str, Any]) -> int:
    """A node that turns all that the scene shows about the place of a neck."""
    corners = []
    for instance in instances(document):
        for primitive in document.array(document.objects("meshes")[instance.mesh], "primitives", "mesh"):
            accessor = document.item("accessors", primitive["attributes"]["POSITION"], "POSITION")
            low, high = accessor.get("min"), accessor.get("max")
            if low is not None and high is not None:
                box = np.array([[low[0], low[1], low[2], 1.0], [high[0], high[1], high[2], 1.0]])
                corners.append((box @ instance.transform.T)[:, :3])
    points = np.concatenate(corners) if corners else np.zeros((1, 3))
    low, high = points.min(0), points.max(0)
    pivot = (low + high) / 2 + np.array(_PIVOT) * (high - low)
    scene, at = root["scenes"][root.get("scene", 0)], len(root["nodes"])
    root["nodes"] += [
        {"name": "head", "translation": pivot.tolist(), "children": [at + 1]},
        {"translation": (-pivot).tolist(), "children": scene["nodes"]},
    ]
    scene["nodes"] = [at]
    return at
