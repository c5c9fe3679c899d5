"""Meshes, rigs and their animations as ``.glb``: metres, y up, shapes as sparse morph targets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import NameMismatchError, TopologyError, ValueRangeError
from torchface.geometry.normal_maps import DetailMaps
from torchface.geometry.operators import vertex_normals
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.container import write_document
from torchface.io.gltf.detail import corner_tangents, write_detail
from torchface.io.gltf.extras import write_extras
from torchface.io.gltf.primitives import decode_srgb
from torchface.io.images import encode_png
from torchface.io.lengths import millimetres_per
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping
from torchface.take import Take

STILL = 1e-4
"""Millimetres; a vertex that a shape moves less than this is written as still."""
_LARGEST_EXACT_ID = 2**24
_SKIN = [0.75, 0.55, 0.45, 1.0]


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

    Vertices are split where texture coordinates differ, as glTF wants it; the attribute ``_VERTEX_ID`` and
    ``mesh.extras.torchface`` bring vertices, polygons and annotations back. A movement under 0.1 micrometre is
    left out. Normals are those of the neutral; morph targets carry none, which halves the file.

    Args:
        rig: the rig.
        path: the file; it appears only when it is complete.
        detail: wrinkle maps of its shapes; see ``torchface.io.gltf.detail``.

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
    """Writes a rig as ``.glb`` with the take's weights as its animation, a key a frame, linear between.

    Args:
        rig: the rig.
        take: with ``weights``; names are matched by ``shape_names.mapping``.
        path: the file; it appears only when it is complete.
        detail: wrinkle maps of the rig's shapes; see ``torchface.io.gltf.detail``.

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
    buffers = BufferWriter()
    tangents = None if detail is None or detail.neutral is None else corner_tangents(mesh)
    vertex_of, uv_of, triangles = _split(mesh, None if tangents is None else tangents[..., 3] < 0)
    attributes = _attributes(mesh, vertex_of, uv_of, buffers)
    if tangents is not None:
        rows = np.tile(np.array([1, 0, 0, 1], np.float32), (len(vertex_of), 1))
        rows[triangles] = tangents
        attributes["TANGENT"] = buffers.vertices(rows)
    primitive: dict[str, Any] = {
        "attributes": attributes,
        "indices": buffers.triangles(triangles),
        "material": 0,
    }
    extras: dict[str, Any] = {"torchface": write_extras(mesh)}
    body: dict[str, Any] = {"name": "face", "primitives": [primitive], "extras": extras}
    if names:
        primitive["targets"] = [{"POSITION": _target(delta, vertex_of, buffers)} for delta in _rows(deltas)]
        body["weights"] = [0.0] * len(names)
        extras["targetNames"] = list(names)
    root: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "torchface"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "face", "mesh": 0}],
        "meshes": [body],
        **_skin(mesh, buffers),
    }
    if detail is not None:
        write_detail(detail, mesh, names, root, buffers)
    if keys is not None:
        root["animations"] = [_animation(*keys, buffers)]
    root |= {"accessors": buffers.accessors, "bufferViews": buffers.views}
    write_document(path, root, buffers.data)


def _split(
    mesh: Mesh, mirrored: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64] | None, NDArray[np.int64]]:
    """One row for each pair of vertex and texture coordinate that occurs.

    Args:
        mesh: the mesh.
        mirrored: at which corners (F,3) the texture is; a pair that is on both sides gets two rows.

    Returns:
        The vertex (C,) and row of ``uvs`` (C,) of each, in the order of the coordinates, then vertices that no face
        has; and the triangles (F,3).
    """
    count = len(mesh.vertices)
    faces = mesh.faces.cpu().numpy()
    if mesh.uvs is None or mesh.uv_faces is None:
        return np.arange(count), None, faces
    keys = mesh.uv_faces.cpu().numpy() * count + faces
    sided = keys * 2 if mirrored is None else keys * 2 + mirrored
    pairs, triangles = np.unique(sided, return_inverse=True)
    vertex_of, uv_of = pairs // 2 % count, pairs // 2 // count
    loose = np.setdiff1d(np.arange(count), vertex_of)
    return np.append(vertex_of, loose), np.append(uv_of, np.zeros_like(loose)), triangles.reshape(-1, 3)


def _attributes(
    mesh: Mesh, vertex_of: NDArray[np.int64], uv_of: NDArray[np.int64] | None, buffers: BufferWriter
) -> dict[str, int]:
    normals = vertex_normals(mesh.vertices.detach().cpu().double(), mesh.faces.cpu())
    normals[normals.norm(dim=1) < 0.5] = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)  # loose, or without area
    attributes = {
        "POSITION": buffers.vertices(_metres(mesh.vertices.detach().cpu().float().numpy())[vertex_of]),
        "NORMAL": buffers.vertices(normals.float().numpy()[vertex_of]),
    }
    if mesh.uvs is not None and uv_of is not None:
        uvs = mesh.uvs.detach().cpu().float().numpy()[uv_of]
        attributes["TEXCOORD_0"] = buffers.vertices(np.stack([uvs[:, 0], 1 - uvs[:, 1]], axis=1))
    if mesh.colors is not None:
        colors = mesh.colors.detach().cpu().float().clamp(0, 1).numpy()
        attributes["COLOR_0"] = buffers.vertices(decode_srgb(colors)[vertex_of])
    if len(mesh.vertices) <= _LARGEST_EXACT_ID:
        attributes["_VERTEX_ID"] = buffers.vertices(vertex_of.astype(np.float32))
    return attributes


def _rows(deltas: Tensor) -> NDArray[np.float32]:
    return deltas.detach().cpu().float().numpy()


def _target(delta: NDArray[np.float32], vertex_of: NDArray[np.int64], buffers: BufferWriter) -> int:
    moves = np.einsum("ij,ij->i", delta, delta) >= STILL * STILL
    return buffers.deltas(_metres(delta * moves[:, None])[vertex_of])


def _metres(millimetres: NDArray[np.float32]) -> NDArray[np.float32]:
    return (millimetres / np.float64(millimetres_per("m"))).astype(np.float32)


def _skin(mesh: Mesh, buffers: BufferWriter) -> dict[str, Any]:
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.6}
    fields: dict[str, Any] = {"materials": [{"name": "skin", "doubleSided": True, "pbrMetallicRoughness": surface}]}
    if mesh.texture is not None and mesh.uvs is not None:
        surface["baseColorTexture"] = {"index": 0}
        view = buffers.view(encode_png(mesh.texture))
        fields["images"] = [{"bufferView": view, "mimeType": "image/png", "name": "skin"}]
        fields["samplers"] = [{"magFilter": 9729, "minFilter": 9987}]
        fields["textures"] = [{"source": 0, "sampler": 0}]
    elif mesh.colors is None:
        surface["baseColorFactor"] = _SKIN
    return fields


def _animation(times: Tensor, weights: Tensor, buffers: BufferWriter) -> dict[str, Any]:
    output = buffers.keys(weights.reshape(-1, 1).numpy())
    sampler = {"input": buffers.keys(times[:, None].numpy(), bounds=True), "output": output, "interpolation": "LINEAR"}
    return {
        "name": "performance",
        "samplers": [sampler],
        "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
    }
