"""Meshes, rigs and their animations as ``.glb``: metres, y up, shapes as sparse morph targets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, TopologyError, ValueRangeError
from torchface.files.whole_files import replaced_file
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.geometry.meshes.uv_seams import split_at_seams
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.container import glb_pieces
from torchface.io.gltf.material_writing import MaterialWriter
from torchface.io.gltf.mesh_extras import write_extras, write_order
from torchface.io.gltf.part_colors.eyes import eye_centre
from torchface.io.gltf.part_colors.surfaces import surfaces
from torchface.io.gltf.primitive_writing import PrimitiveWriter, metres
from torchface.io.gltf.wrinkle_maps import corner_tangents, write_detail
from torchface.io.length_units import millimetres_per
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping
from torchface.take import Take


@dataclass(frozen=True)
class ShapeMatch:
    """Which of a rig's shapes a take's channels drive.

    Args:
        driven: shapes of the rig that follow a channel.
        missing: shapes of the rig that no channel drives; they stay at 0.
        unused: channels of the take that the rig has no shape for.
    """

    driven: tuple[str, ...]
    missing: tuple[str, ...]
    unused: tuple[str, ...]


def write_gltf_rig(rig: BlendshapeRig, path: str | Path, detail: DetailMaps | None = None) -> None:
    """Writes a rig as ``.glb`` in metres.

    Each part that is named by a region (``region_materials``) is a primitive of its own material; an eyeball is a
    mesh of its own under a node at its centre. Vertices are split at the borders of primitives and where texture
    coordinates differ, as glTF wants it; the attribute ``_VERTEX_ID`` and ``mesh.extras.torchface`` bring vertices,
    polygons and annotations back in their order. Morph targets carry positions and normals, sparse where that is
    smaller; what moves less than 0.1 micrometre or rotates a normal less than 8 bits of shading show is left out.

    Args:
        rig: the rig.
        path: the file; it appears only when it is complete.
        detail: wrinkle maps of its shapes; see ``torchface.io.gltf.wrinkle_maps``.

    Raises:
        FileFormatError: the folder cannot be written to.
        TopologyError: the mesh has no triangle, or wrinkle maps and no texture coordinates.
        NameMismatchError: a wrinkle map belongs to no shape of the rig.
    """
    _write(path, rig.neutral, rig.deltas, rig.names, None, detail)


def save_gltf_mesh(mesh: Mesh, path: str | Path) -> None:
    """Writes a mesh as ``.glb`` in metres; see ``write_gltf_rig``."""
    _write(path, mesh, torch.zeros(0, *mesh.vertices.shape), (), None)


def save_animation(rig: BlendshapeRig, take: Take, path: str | Path, detail: DetailMaps | None = None) -> ShapeMatch:
    """Writes a rig as ``.glb`` with the take's weights as its animation, a key a frame at its time, linear between.

    Args:
        rig: the rig.
        take: with ``weights``; names are matched by ``shape_names.mapping``.
        path: the file; it appears only when it is complete.
        detail: wrinkle maps of the rig's shapes; see ``torchface.io.gltf.wrinkle_maps``.

    Returns:
        ``ShapeMatch(driven, missing, unused)``.

    Raises:
        NameMismatchError: no channel drives any shape, or a wrinkle map belongs to none.
        ValueRangeError: the take has no weights or no frame, or a weight is NaN.
        FileFormatError: the folder cannot be written to.
    """
    track = take.weights
    if track is None or len(track) == 0 or track.values.shape[2] != 1:
        found = "no weights" if track is None else f"weights {tuple(track.values.shape)}"
        raise ValueRangeError(f"take: found {found}, expected weights (T,N,1) of at least one frame")
    values = track.values[..., 0].detach().cpu().float()
    if not torch.isfinite(values).all():
        frames = (~torch.isfinite(values)).any(1).nonzero()[:, 0]
        raise ValueRangeError(
            f"take: found NaN in the weights of {len(frames)} frames, first {int(frames[0])}; expected numbers"
        )
    matrix = mapping(track.names, rig.names)
    drives = matrix != 0
    if not drives.any():
        raise NameMismatchError(
            f"take: none of its {len(track.names)} channels ({', '.join(track.names[:5])}, ...) drives one of the "
            f"rig's {len(rig.names)} shapes ({', '.join(rig.names[:5])}, ...)"
        )
    times = take.uneven_seconds()
    if times is None:
        times = torch.arange(len(values), dtype=torch.float64) / take.fps
    _write(path, rig.neutral, rig.deltas, rig.names, (times.float(), values @ matrix.T), detail)
    by_shape, by_channel = drives.any(1).tolist(), drives.any(0).tolist()
    return ShapeMatch(
        tuple(name for name, is_driven in zip(rig.names, by_shape, strict=True) if is_driven),
        tuple(name for name, is_driven in zip(rig.names, by_shape, strict=True) if not is_driven),
        tuple(name for name, is_used in zip(track.names, by_channel, strict=True) if not is_used),
    )


def _write(
    path: str | Path,
    mesh: Mesh,
    deltas: Tensor,
    names: tuple[str, ...],
    keys: tuple[Tensor, Tensor] | None,
    detail: DetailMaps | None = None,
) -> None:
    if len(mesh.faces) == 0:
        raise TopologyError(f"{path}: the mesh has no triangle; glTF needs one")
    mesh, buffers = mesh.to("cpu"), BufferWriter()
    tangents = None if detail is None or detail.neutral is None else corner_tangents(mesh)
    mirrored = None if tangents is None else tangents[..., 3] < 0
    uv_faces = None if mesh.uv_faces is None else mesh.uv_faces.numpy()
    split = split_at_seams(len(mesh.vertices), mesh.faces.numpy(), uv_faces, mirrored)
    writer, materials = PrimitiveWriter(mesh, split, buffers, tangents), MaterialWriter(mesh, buffers)
    parts = surfaces(mesh, mesh.texture is not None or detail is not None)
    if all(surface.part is not None for surface in parts):  # nothing but eyeballs: none is another's child
        parts = [replace(surface, part=None) for surface in parts]
    nodes: list[dict[str, Any]] = []
    meshes: list[dict[str, Any]] = []
    order: list[Tensor] = []
    for name in dict.fromkeys([None, *(surface.part for surface in parts)]):
        mine = [surface for surface in parts if surface.part == name]
        rows = torch.cat([surface.triangles for surface in mine])
        origin = torch.zeros(3) if name is None else eye_centre(mesh, rows)
        node: dict[str, Any] = {"name": name or "face", "mesh": len(meshes)}
        if name is not None:
            node["translation"] = [float(value) for value in metres(origin.numpy())]
            origin = torch.tensor(node["translation"], dtype=torch.float64) * millimetres_per("m")
        primitives = [writer.add(surface, materials.add(surface), origin) for surface in mine]
        body: dict[str, Any] = {"name": node["name"], "primitives": primitives, "extras": {}}
        if names:
            body |= {"weights": [0.0] * len(names), "extras": {"targetNames": list(names)}}
        nodes.append(node)
        meshes.append(body)
        order.append(rows)
    writer.add_targets(deltas)
    meshes[0]["extras"]["torchface"] = write_extras(mesh) | write_order(torch.cat(order), len(meshes))
    if len(nodes) > 1:
        nodes[0]["children"] = list(range(1, len(nodes)))
    root: dict[str, Any] = {
        "nodes": nodes,
        "meshes": meshes,
        **materials.fields,
    }
    if detail is not None:
        write_detail(detail, mesh, names, root, buffers)
    if keys is not None:
        root["animations"] = [_animation(*keys, len(nodes), buffers)]
    with replaced_file(path) as temporary, temporary.open("wb") as file:
        file.writelines(glb_pieces(root, buffers, path))


def _animation(times: Tensor, weights: Tensor, nodes: int, buffers: BufferWriter) -> dict[str, Any]:
    output = buffers.keys(weights.reshape(-1, 1).numpy())
    sampler = {"input": buffers.keys(times[:, None].numpy(), bounds=True), "output": output, "interpolation": "LINEAR"}
    return {
        "name": "performance",
        "samplers": [sampler],
        "channels": [{"sampler": 0, "target": {"node": node, "path": "weights"}} for node in range(nodes)],
    }
