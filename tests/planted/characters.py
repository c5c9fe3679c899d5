"""Characters by code: a head with a body of boxes, a skeleton, hair and materials in a ``.glb`` or ``.vrm``."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from planted.glb_files import packed
from torchface.geometry.meshes.operators import components, edges, vertex_normals
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.images.image_files import encode_png
from torchface.mesh import Mesh, submesh
from torchface.rig import BlendshapeRig

_BONES = (("Hips", None, -900.0), ("Spine", 0, -650.0), ("Neck", 1, -140.0), ("Head", 2, -60.0))
_PARTS = (  # of the body: middle and extent, millimetres below the head
    ((0, -420, -20), (360, 480, 200)),
    ((-250, -400, -20), (90, 520, 90)),
    ((250, -400, -20), (90, 520, 90)),
    ((-95, -1060, -20), (130, 800, 140)),
    ((95, -1060, -20), (130, 800, 140)),
)
_SKIN = (0.86, 0.68, 0.58, 1.0)


@dataclass(frozen=True)
class Planted:
    """How a character is written."""

    turn: Tensor | None = None  # the whole of it, (3,3); upright if absent
    units: float = 1.0  # numbers of the file a metre: 100 for centimetres
    body: bool = True  # a body of boxes, hair and a skeleton
    vrm: str | None = None  # "VRMC_vrm" (1.0), "VRM" (0.x) or none
    prefix: str = "mixamorig:"  # of the bones' names
    extra_heads: tuple[float, ...] = ()  # copies of the head beside, millimetres to the right of it
    expressions: Mapping[str, str] = field(default_factory=dict)


UPRIGHT = Planted()


def write_character(path: Path, head: Mesh, shapes: Mapping[str, Tensor] | None = None, how: Planted = UPRIGHT) -> int:
    """Writes a character; how many vertices its first mesh has. The head's vertices are that mesh's first.

    Args:
        path: the file.
        head: millimetres.
        shapes: of the head, by name, (V,3) each.
        how: see :class:`Planted`.
    """
    shapes = dict(shapes or {})
    buffers = BufferWriter()
    vertices, faces = head.vertices.double(), head.faces
    count = len(vertices)
    bone = torch.full((count,), 3)
    for shift in how.extra_heads:
        moved = head.vertices.double() + torch.tensor([shift, 0.0, 0.0])
        faces = torch.cat([faces, head.faces + len(vertices)])
        vertices, bone = torch.cat([vertices, moved]), torch.cat([bone, torch.full((count,), 3)])
    if how.body:
        for middle, extent in _PARTS:
            box, triangles = box_mesh(torch.tensor(middle), torch.tensor(extent))
            faces = torch.cat([faces, triangles + len(vertices)])
            vertices, bone = torch.cat([vertices, box]), torch.cat([bone, torch.full((len(box),), 1)])
    metres = (vertices / 1000).numpy().astype(np.float32)
    normals = vertex_normals(vertices, faces).numpy().astype(np.float32)
    attributes = {"POSITION": buffers.vertices(metres), "NORMAL": buffers.vertices(normals)}
    root: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "planted", "extras": {"licence": "none"}},
        "materials": [
            {"name": "Skin", "pbrMetallicRoughness": {"baseColorFactor": list(_SKIN)}},
            {"name": "Hair", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "alphaMode": "MASK"},
        ],
    }
    buffers.texture(root, encode_png(torch.full((4, 8, 8), 0.25).index_fill(0, torch.tensor([3]), 1.0)))
    primitive: dict[str, Any] = {"attributes": attributes, "indices": buffers.triangles(faces.numpy()), "material": 0}
    if shapes:
        full = torch.zeros(len(shapes), len(vertices), 3)
        full[:, :count] = torch.stack(list(shapes.values()))
        primitive["targets"] = [{"POSITION": buffers.deltas((one / 1000).numpy())} for one in full]
    mesh = {"name": "Body", "primitives": [primitive], "extras": {"author": "nobody", "targetNames": list(shapes)}}
    if not shapes:
        mesh["extras"] = {"author": "nobody"}
    root["meshes"] = [mesh]
    root["nodes"] = [{"name": "Body", "mesh": 0}]
    turned = np.eye(4)
    turned[:3, :3] = how.units * (np.eye(3) if how.turn is None else how.turn.numpy())
    if how.body:
        _skeleton(root, buffers, attributes, bone.numpy(), turned, how)
    else:
        root["nodes"][0]["matrix"] = turned.T.flatten().tolist()
        root["scenes"] = [{"nodes": [0]}]
    if shapes:
        times = buffers.keys(np.array([[0.0], [1.0]], np.float32), bounds=True)
        values = buffers.keys(np.zeros((2 * len(shapes), 1), np.float32))
        root["animations"] = [
            {
                "name": "talk",
                "samplers": [{"input": times, "output": values, "interpolation": "LINEAR"}],
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
            }
        ]
    if how.vrm:
        _vrm(root, how, list(shapes))
    root["scene"] = 0
    root |= {"accessors": buffers.accessors, "bufferViews": buffers.views, "buffers": [{"byteLength": buffers.size}]}
    path.write_bytes(packed(root, b"".join(buffers.pieces)))
    return len(vertices)


def box_mesh(middle: Tensor, extent: Tensor, divisions: int = 1) -> tuple[Tensor, Tensor]:
    """A box (8 vertices, 12 triangles that face outward)."""
    corners = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=torch.float64) / 2
    quads = torch.tensor([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    vertices, faces = middle + corners * extent, torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    for _ in range(divisions - 1):
        vertices, faces = subdivided(vertices, faces)[:2]
    return vertices, faces


def subdivided(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Each triangle in four; vertices, faces, and the pairs whose middles the new vertices are."""
    pairs = edges(faces)
    key = {tuple(pair): len(vertices) + row for row, pair in enumerate(pairs.tolist())}
    middle = [
        torch.tensor([key[(min(a, b), max(a, b))] for a, b in faces[:, [i, j]].tolist()])
        for i, j in ((0, 1), (1, 2), (2, 0))
    ]
    a, b, c = faces.T
    ab, bc, ca = middle
    new = torch.cat([torch.stack(one, 1) for one in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return torch.cat([vertices, vertices[pairs].mean(1)]), new, pairs


def other_topology(rig: BlendshapeRig, seed: int = 0) -> BlendshapeRig:
    """The rig with every triangle in four and its vertices in another order."""
    vertices, faces, pairs = subdivided(rig.vertices, rig.neutral.faces)
    deltas = torch.cat([rig.deltas, rig.deltas[:, pairs].mean(2)], 1)
    order = torch.randperm(len(vertices), generator=torch.Generator().manual_seed(seed))
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    return BlendshapeRig.from_tensors(vertices[order], place[faces], deltas[:, order], rig.names)


def caricature(
    rig: BlendshapeRig, landmarks: Tensor, eyes: float = 0.45, lips: float = 0.5, nose: float = 0.6
) -> BlendshapeRig:
    """The rig in a space that is warped: eyes and lips larger, the nose flatter; shapes are warped with it.

    Args:
        rig: millimetres, upright.
        landmarks: iBUG's 68 of it, (68,3).
        eyes: by how much larger at their middles.
        lips: likewise, in height.
        nose: by how much of its height it is flatter.
    """
    marks = landmarks.double()
    mouth, tip = marks[48:68].mean(0), marks[30]
    height = float(tip[2] - marks[[31, 35]].mean(0)[2])

    def warped(points: Tensor) -> Tensor:
        moved = points.double()
        for eye in (marks[36:42].mean(0), marks[42:48].mean(0)):
            away = moved - eye
            moved = moved + eyes * away * torch.exp(-((away.norm(dim=-1, keepdim=True) / 26) ** 2))
        away = moved - mouth
        swell = lips * torch.exp(-((away / torch.tensor([34.0, 16.0, 30.0])) ** 2).sum(-1))
        moved = moved + swell[..., None] * away * torch.tensor([0.0, 1.0, 0.3])
        near = torch.exp(-(((moved - tip) / torch.tensor([16.0, 20.0, 30.0])) ** 2).sum(-1))
        return moved - nose * height * near[..., None] * torch.tensor([0.0, 0.0, 1.0])

    rest = warped(rig.vertices)
    deltas = torch.stack([warped(rig.vertices + one) - rest for one in rig.deltas])
    return BlendshapeRig(rig.neutral.with_vertices(rest.float()), deltas.float(), rig.names)


def _skeleton(
    root: dict[str, Any],
    buffers: BufferWriter,
    attributes: dict[str, int],
    bone: np.ndarray,
    turned: np.ndarray,
    how: Planted,
) -> None:
    """Bones under a turned and scaled root, a skin, and hair under the head's bone."""
    nodes, joints = root["nodes"], []
    heights = [height / 1000 for _, _, height in _BONES]
    binds = []
    for name, parent, height in _BONES:
        local = height / 1000 - (0.0 if parent is None else heights[parent])
        joints.append(len(nodes))
        nodes.append({"name": how.prefix + name, "translation": [0.0, local, 0.0]})
        if parent is not None:
            nodes[joints[parent]].setdefault("children", []).append(joints[-1])
        bind = np.eye(4)
        bind[1, 3] = -height / 1000
        binds.append(bind.T.flatten())
    nodes.append({"name": "Armature", "matrix": turned.T.flatten().tolist(), "children": [joints[0]]})
    armature = len(nodes) - 1
    ids = np.zeros((len(bone), 4), np.float32)
    ids[:, 0] = bone
    weights = np.zeros((len(bone), 4), np.float32)
    weights[:, 0] = 1.0
    view = buffers.view(ids.astype(np.uint8).tobytes())
    buffers.accessors.append({"bufferView": view, "componentType": 5121, "count": len(ids), "type": "VEC4"})
    attributes["JOINTS_0"] = len(buffers.accessors) - 1
    attributes["WEIGHTS_0"] = buffers.vertices(weights)
    view = buffers.view(np.stack(binds).astype("<f4").tobytes())
    buffers.accessors.append({"bufferView": view, "componentType": 5126, "count": len(binds), "type": "MAT4"})
    root["skins"] = [{"joints": joints, "inverseBindMatrices": len(buffers.accessors) - 1, "skeleton": joints[0]}]
    nodes[0]["skin"] = 0
    hair, triangles = _cap()
    positions = buffers.vertices((hair.numpy() / 1000 - np.array([0, heights[3], 0])).astype(np.float32))
    uvs = buffers.vertices(np.zeros((len(hair), 2), np.float32))
    strands = {"attributes": {"POSITION": positions, "TEXCOORD_0": uvs}, "material": 1}
    root["meshes"].append(
        {"name": "Hair", "primitives": [{**strands, "indices": buffers.triangles(triangles.numpy())}]}
    )
    nodes.append({"name": "Hair", "mesh": 1, "extras": {"physics": [0.5, 0.25]}})
    nodes[joints[3]].setdefault("children", []).append(len(nodes) - 1)
    root["scenes"] = [{"nodes": [0, armature]}]


def _cap() -> tuple[Tensor, Tensor]:
    """Hair: the upper back of an ellipsoid round the cranium."""
    across, up = torch.meshgrid(torch.linspace(0, 2 * np.pi, 25)[:-1], torch.linspace(0.15, 1.45, 8), indexing="ij")
    x, y, z = up.sin() * across.sin(), up.cos(), up.sin() * across.cos()
    points = torch.stack([96 * x, 30 + 92 * y, -20 + 118 * z], -1).double()
    grid = torch.arange(24 * 8).view(24, 8)
    behind = torch.cat([grid, grid[:1]])
    quads = torch.stack([behind[:-1, :-1], behind[:-1, 1:], behind[1:, 1:], behind[1:, :-1]], -1).reshape(-1, 4)
    front = points.reshape(-1, 3)[quads].mean(1)
    quads = quads[(front[:, 2] < 30) | (front[:, 1] > 96)]
    return points.reshape(-1, 3), torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _vrm(root: dict[str, Any], how: Planted, shapes: list[str]) -> None:
    node = {bone["name"].removeprefix(how.prefix).lower(): i for i, bone in enumerate(root["nodes"])}
    bones = {name: node[name] for name in ("hips", "spine", "neck", "head")}
    for parent, limb in (("hips", ("UpperLeg", "LowerLeg", "Foot")), ("spine", ("UpperArm", "LowerArm", "Hand"))):
        for side, across in (("left", 1.0), ("right", -1.0)):
            above = bones[parent]
            for bone in limb:  # bones that VRM asks for and nothing is bound to
                bones[side + bone] = len(root["nodes"])
                root["nodes"].append({"name": side + bone, "translation": [0.1 * across, -0.1, 0.0]})
                root["nodes"][above].setdefault("children", []).append(bones[side + bone])
                above = bones[side + bone]
    root["extensionsUsed"] = [how.vrm]
    index = {name: row for row, name in enumerate(shapes)}
    if how.vrm == "VRMC_vrm":
        preset = {
            expression: {"morphTargetBinds": [{"node": 0, "index": index[shape], "weight": 1.0}], "isBinary": False}
            for expression, shape in how.expressions.items()
        }
        root["extensions"] = {
            "VRMC_vrm": {
                "specVersion": "1.0",
                "meta": {"name": "planted", "authors": ["nobody"], "licenseUrl": "https://vrm.dev/licenses/1.0/"},
                "humanoid": {"humanBones": {name: {"node": number} for name, number in bones.items()}},
                "lookAt": {"type": "bone", "offsetFromHeadBone": [0.0, 0.06, 0.0]},
                "firstPerson": {"meshAnnotations": [{"node": 0, "type": "auto"}]},
                "expressions": {"preset": preset},
            }
        }
        return
    groups = [
        {"name": name, "presetName": name.lower(), "binds": [{"mesh": 0, "index": index[shape], "weight": 100}]}
        for name, shape in how.expressions.items()
    ]
    root["extensions"] = {
        "VRM": {
            "specVersion": "0.0",
            "meta": {"title": "planted"},
            "humanoid": {"humanBones": [{"bone": name, "node": number} for name, number in bones.items()]},
            "firstPerson": {"firstPersonBone": node["head"], "lookAtTypeName": "Bone"},
            "blendShapeMaster": {"blendShapeGroups": groups},
        }
    }


def decimated(rig: BlendshapeRig, count: int) -> BlendshapeRig:
    """The rig with at most so many triangles: vertices of one cell of a grid, one part and one side are one."""
    vertices, faces = rig.vertices.double(), rig.neutral.faces
    part, facing = components(faces, len(vertices)), vertex_normals(vertices, faces)
    cell = 1.0
    while len(faces) > count:
        key = torch.cat([(vertices / cell).round().long(), facing.round().long(), part[:, None]], 1)
        _, of = key.unique(dim=0, return_inverse=True)
        kept = torch.zeros(int(of.max()) + 1, dtype=torch.int64)
        kept[of.flip(0)] = torch.arange(len(of)).flip(0)
        faces = of[rig.neutral.faces]
        faces = faces[(faces != faces.roll(1, 1)).all(1)]
        cell *= 1.1
    return BlendshapeRig.from_tensors(rig.vertices[kept], faces, rig.deltas[:, kept], rig.names)


def without(rig: BlendshapeRig, *regions: str) -> BlendshapeRig:
    """The rig without some of its regions, holes in their place."""
    notes = rig.neutral.annotations
    assert notes is not None
    gone = torch.stack([notes.regions[name] for name in regions]).any(0)
    piece = submesh(rig.neutral, ~gone)
    return BlendshapeRig(piece.mesh, rig.deltas[:, piece.vertex_ids], rig.names)
