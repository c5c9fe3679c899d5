"""Meshes, rigs and their animations as ``.glb``: metres, y up, shapes as sparse morph targets."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.correctives.corrective_shapes import Corrective
from torchface.errors import TopologyError
from torchface.files.whole_files import replaced_file
from torchface.geometry.meshes.normal_maps import DetailMaps, SurfaceMaps
from torchface.geometry.meshes.region_maps import RegionMaps
from torchface.geometry.meshes.uv_seams import split_at_seams
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.corrective_extras import all_targets, write_correctives
from torchface.io.gltf.detail_textures import corner_tangents, write_detail, write_surface
from torchface.io.gltf.gltf_document import glb_pieces
from torchface.io.gltf.mesh_extras import write_extras, write_order
from torchface.io.gltf.part_textures.head_primitives import surfaces
from torchface.io.gltf.part_textures.iris_texture import eye_centre
from torchface.io.gltf.primitive_writing import MaterialWriter, PrimitiveWriter, metres
from torchface.io.gltf.wrinkle_textures import write_region_maps
from torchface.io.length_units import millimetres_per
from torchface.io.scenes.weight_keys import WeightKeys, with_correctives
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig


def write_gltf_rig(
    rig: BlendshapeRig,
    path: str | Path,
    detail: DetailMaps | RegionMaps | SurfaceMaps | None = None,
    keys: WeightKeys | None = None,
) -> None:
    """Writes a rig as ``.glb`` in metres.

    Each part that is named by a region (``part_materials``) is a primitive of its own material; an eyeball is a mesh
    of its own under a node at its centre. Vertices are split at the borders of primitives and where texture coordinates
    differ, as glTF wants it; the attribute ``_VERTEX_ID`` and ``mesh.extras.torchface`` bring vertices, polygons and
    annotations back in their order. Morph targets carry positions and normals, sparse where that is smaller;
    correctives come after the shapes; what moves less than 0.1 micrometre or rotates a normal less than 8 bits of
    shading show is left out.

    Args:
        detail: detail maps of its shapes, see ``torchface.io.gltf.detail_textures``, or of its regions, see
            ``torchface.io.gltf.wrinkle_textures``; or the surface's normals and roughness, with which images are JPEG.
        keys: an animation of its shapes, linear between keys.
    """
    definitions = () if rig.correctives is None else rig.correctives.definitions
    _write(path, rig.neutral, *all_targets(rig), keys and with_correctives(rig, keys), detail, definitions)


def save_gltf_mesh(mesh: Mesh, path: str | Path) -> None:
    """Writes a mesh as ``.glb`` in metres; see ``write_gltf_rig``."""
    _write(path, mesh, torch.zeros(0, *mesh.vertices.shape), (), None)


def _write(
    path: str | Path,
    mesh: Mesh,
    deltas: Tensor,
    names: tuple[str, ...],
    keys: WeightKeys | None,
    detail: DetailMaps | RegionMaps | SurfaceMaps | None = None,
    correctives: Sequence[Corrective] = (),
) -> None:
    if len(mesh.faces) == 0:
        raise TopologyError(f"{path}: the mesh has no triangle; glTF needs one")
    mesh, buffers = mesh.to("cpu"), BufferWriter()
    tangents = None if detail is None or detail.neutral is None else corner_tangents(mesh)
    mirrored = None if tangents is None else tangents[..., 3] < 0
    uv_faces = None if mesh.uv_faces is None else mesh.uv_faces.numpy()
    split = split_at_seams(len(mesh.vertices), mesh.faces.numpy(), uv_faces, mirrored)
    writer, materials = (
        PrimitiveWriter(mesh, split, buffers, tangents),
        MaterialWriter(mesh, buffers, jpeg=isinstance(detail, SurfaceMaps)),
    )
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
    meshes[0]["extras"]["torchface"] |= write_correctives(correctives)
    if len(nodes) > 1:
        nodes[0]["children"] = list(range(1, len(nodes)))
    root: dict[str, Any] = {"nodes": nodes, "meshes": meshes, **materials.fields}
    if isinstance(detail, RegionMaps):
        write_region_maps(detail, root, buffers)
    elif isinstance(detail, SurfaceMaps):
        write_surface(detail, root, buffers)
    elif detail is not None:
        write_detail(detail, mesh, names, root, buffers)
    if keys is not None:
        root["animations"] = [_animation(keys, len(nodes), buffers)]
    with replaced_file(path) as temporary, temporary.open("wb") as file:
        file.writelines(glb_pieces(root, buffers, path))


def _animation(keys: WeightKeys, nodes: int, buffers: BufferWriter) -> dict[str, Any]:
    output = buffers.keys(keys.weights.reshape(-1, 1).numpy())
    times = buffers.keys(keys.seconds[:, None].float().numpy(), bounds=True)
    sampler = {"input": times, "output": output, "interpolation": "LINEAR"}
    return {
        "name": "performance",
        "samplers": [sampler],
        "channels": [{"sampler": 0, "target": {"node": node, "path": "weights"}} for node in range(nodes)],
    }
