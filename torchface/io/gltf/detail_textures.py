"""Detail maps in a ``.glb``: the neutral's as the material's normal texture, where every viewer shows it; the shapes'
as further textures, which ``mesh.extras.torchface.wrinkleMaps`` lists as ``{"shape": name, "texture": index}``.

With the neutral's map come the tangents of ``torchface.geometry.meshes.tangent_space``, which are MikkTSpace's; the
file's normals are the ones that maps are baked about. Images have 8 bits a channel, as viewers show them.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import NameMismatchError, TopologyError
from torchface.geometry.meshes.normal_maps import DetailMaps, SurfaceMaps, decode_normals, encode_normals
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.tangent_space import tangent_space
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.gltf_document import Document, read_document
from torchface.io.gltf.gltf_reading import read_texture
from torchface.io.images.image_files import encode_jpeg, encode_png
from torchface.mesh import Mesh

_LIST = "wrinkleMaps"
_UNPACKED_ALWAYS = 2**28
_UNPACKED_PER_BYTE = 1024  # wrinkles on a flat ground pack well, but not a thousand times


def write_detail(
    detail: DetailMaps, mesh: Mesh, names: Sequence[str], root: dict[str, Any], buffers: BufferWriter
) -> None:
    """Adds maps to a document under construction whose first mesh and material are the face's."""
    check_detail(detail, mesh, names)
    if detail.neutral is not None:
        image = encode_png(encode_normals(detail.neutral))
        root["materials"][0]["normalTexture"] = {"index": buffers.texture(root, image, name="neutral_normals")}
    listed = [
        {"shape": name, "texture": buffers.texture(root, encode_png(encode_normals(normals)), name=f"{name}_normals")}
        for name, normals in zip(detail.names, detail.maps, strict=True)
    ]
    root["meshes"][0]["extras"]["torchface"][_LIST] = listed


def write_surface(surface: SurfaceMaps, root: dict[str, Any], buffers: BufferWriter) -> None:
    """Adds normals and roughness to the first material of a document under construction, as JPEG."""
    skin = root["materials"][0]
    normals = encode_jpeg(encode_normals(surface.neutral))
    skin["normalTexture"] = {"index": buffers.texture(root, normals, "image/jpeg", "skin_normals")}
    rough = surface.roughness[0]
    channels = encode_jpeg(torch.stack([torch.ones_like(rough), rough, torch.zeros_like(rough)]))
    index = buffers.texture(root, channels, "image/jpeg", "skin_roughness")
    skin["pbrMetallicRoughness"] |= {"roughnessFactor": 1.0, "metallicRoughnessTexture": {"index": index}}


def check_detail(detail: DetailMaps, mesh: Mesh, names: Sequence[str]) -> None:
    """Checks that a rig's file can hold maps."""
    if mesh.uvs is None:
        raise TopologyError("detail: found detail maps for a mesh without texture coordinates, expected uvs")
    missing = [name for name in detail.names if name not in names]
    if missing:
        raise NameMismatchError(f"detail: the rig has no shape {', '.join(map(repr, missing[:5]))}")


def corner_tangents(mesh: Mesh) -> NDArray[np.float32]:
    """glTF's tangents at each triangle's corners, (F,3,4); the last number is the bitangent's sign."""
    if mesh.uvs is None or mesh.uv_faces is None:
        raise TopologyError("detail: found detail maps for a mesh without texture coordinates, expected uvs")
    points, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
    normals = vertex_normals(points, faces)
    space = tangent_space(points, faces, mesh.uvs.detach().cpu().double(), mesh.uv_faces.cpu(), normals)
    rows = torch.cat([space.tangents, space.signs[:, None]], dim=1)[space.tangent_faces]
    return rows.float().numpy()


def read_gltf_detail(path: str | Path) -> DetailMaps | None:
    """The detail maps of a ``.glb``; none where it has neither such maps nor a normal texture."""
    document = read_document(path)
    listed, mesh = _listed(document)
    names = [_name(document, entry, i) for i, entry in enumerate(listed)]
    if len(set(names)) != len(names):
        raise document.error(f"extras.torchface.{_LIST}", names, "each shape once")
    neutral = normal_texture(document, mesh)
    indices = [*([] if neutral is None else [neutral]), *(entry.get("texture") for entry in listed)]
    if not indices:
        return None
    images = TextureReader(document, path).stacked(indices, _LIST)
    maps = torch.stack([decode_normals(image) for image in images])
    return DetailMaps(tuple(names), maps, None) if neutral is None else DetailMaps(tuple(names), maps[1:], maps[0])


def _listed(document: Document) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The list of the first mesh that has one, and that mesh; else the first mesh."""
    found = document.first_extras(_LIST)
    if found is None:
        meshes = document.objects("meshes")
        return [], meshes[0] if meshes else {}
    mesh, location = found
    rows = document.array(mesh["extras"]["torchface"], _LIST, location)
    return [document.record(row, f"{location}.{_LIST}[{k}]") for k, row in enumerate(rows)], mesh


def _name(document: Document, entry: dict[str, Any], index: int) -> str:
    name = entry.get("shape")
    if not isinstance(name, str) or not name:
        raise document.error(f"{_LIST}[{index}].shape", name, "the name of a shape")
    return name


def normal_texture(document: Document, mesh: dict[str, Any]) -> int | None:
    """The index of the first normal texture among a mesh's materials."""
    for i, row in enumerate(document.array(mesh, "primitives", "mesh")):
        primitive = document.record(row, f"primitives[{i}]")
        if primitive.get("material") is not None:
            material = document.item("materials", primitive["material"], f"primitives[{i}].material")
            texture = document.record(material.get("normalTexture"), "normalTexture")
            if texture:
                return document.integer(texture, "index", "normalTexture")
    return None


class TextureReader:
    """Reads a file's textures, as long as they unpack to no more than such a file can hold."""

    def __init__(self, document: Document, path: str | Path) -> None:
        self._document = document
        self._unpacked, self._allowed = 0, max(_UNPACKED_ALWAYS, _UNPACKED_PER_BYTE * Path(path).stat().st_size)

    def stacked(self, indices: Sequence[object], location: str) -> Tensor:
        """Images (K,3,H,W) in [0,1] of one size, one at least."""
        images: list[Tensor] = []
        for index in indices:
            image = self._read(index, location)
            if images and image.shape != images[0].shape:
                sizes = f"maps of {tuple(images[0].shape[1:])} and {tuple(image.shape[1:])}"
                raise self._document.error(location, sizes, "one size")
            images.append(image)
        return torch.stack(images)

    def _read(self, index: object, location: str) -> Tensor:
        """An image (3,H,W) in [0,1]."""
        self._document.item("textures", index, f"{location}.texture")
        assert isinstance(index, int)
        image = read_texture(self._document, index)
        if image is None:
            raise self._document.error(f"textures[{index}]", "no source", "a PNG or JPEG")
        self._unpacked += image.numel() * 4
        if self._unpacked > self._allowed:
            raise self._document.error(
                location, f"maps that unpack to {self._unpacked} bytes", f"at most {self._allowed}"
            )
        return image
