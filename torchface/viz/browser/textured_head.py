"""A head with its texture, vertex colours and wrinkles as the bytes of a small glTF file."""

from __future__ import annotations

import io
import json
import struct
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from torchface.color_space import to_linear
from torchface.geometry.meshes.normal_maps import encode_normals
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io.gltf.buffers import BufferWriter
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import CLAY
from torchface.rendering.compositing import to_pillow

_LARGEST_SIDE = 2048
_LARGEST_NORMALS = 1024
_QUALITY = 90
_ROUGHNESS = 0.72


class Skin:
    """A mesh's look, prepared once; positions, and wrinkles where there are some, go in each time.

    Args:
        mesh: its texture is used where it has one, else its vertex colours, else clay.
    """

    def __init__(self, mesh: Mesh) -> None:
        mesh = mesh.to("cpu")
        self._faces = mesh.faces
        self._uvs = self._colors = None
        if mesh.uvs is not None and mesh.uv_faces is not None:
            # A vertex on a seam of the texture is one in the mesh and several in glTF.
            unique, indices = (mesh.faces * len(mesh.uvs) + mesh.uv_faces).unique(return_inverse=True)
            self._vertex_of, self._indices = unique // len(mesh.uvs), indices.numpy()
            uvs = mesh.uvs[unique % len(mesh.uvs)].float()
            self._uvs = torch.stack([uvs[:, 0], 1 - uvs[:, 1]], dim=1).numpy()
        else:
            self._vertex_of, self._indices = torch.arange(len(mesh.vertices)), mesh.faces.numpy()
        self._picture = None
        self._material: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": _ROUGHNESS}
        if mesh.texture is not None and self._uvs is not None:
            self._picture = _encoded(to_pillow(mesh.texture), "JPEG", _LARGEST_SIDE)
        elif mesh.colors is not None:
            # glTF wants vertex colours linear, the mesh holds them as a picture does.
            self._colors = to_linear(mesh.colors.clamp(0, 1).float()[self._vertex_of]).numpy()
        else:
            clay = to_linear(torch.tensor(CLAY)).tolist()
            self._material["baseColorFactor"] = [*clay, 1.0]

    def glb(self, vertices: Tensor, wrinkles: Tensor | None = None) -> bytes:
        """A ``.glb`` of the mesh.

        Args:
            vertices: (V,3), in their own unit.
            wrinkles: a normal map of unit vectors in tangent space, (3,H,W); left out where the mesh has no UVs.
        """
        here = vertices.detach().cpu().float()
        buffers = BufferWriter()
        pictures: list[dict[str, Any]] = []
        attributes = {
            "POSITION": buffers.vertices(here[self._vertex_of].numpy()),
            # Without normals a viewer has to draw facets; these run smoothly across the texture's seams.
            "NORMAL": buffers.vertices(vertex_normals(here, self._faces)[self._vertex_of].numpy()),
        }
        if self._uvs is not None:
            attributes["TEXCOORD_0"] = buffers.vertices(self._uvs)
        if self._colors is not None:
            attributes["COLOR_0"] = buffers.vertices(self._colors)
        primitive = {"attributes": attributes, "indices": buffers.triangles(self._indices), "material": 0}
        material: dict[str, Any] = {"pbrMetallicRoughness": dict(self._material), "doubleSided": True}
        if self._picture is not None:
            material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": len(pictures)}
            pictures.append({"bufferView": buffers.view(self._picture), "mimeType": "image/jpeg"})
        if wrinkles is not None and self._uvs is not None:
            material["normalTexture"] = {"index": len(pictures)}
            picture = _encoded(to_pillow(encode_normals(wrinkles.cpu().float())), "PNG", _LARGEST_NORMALS)
            pictures.append({"bufferView": buffers.view(picture), "mimeType": "image/png"})
        document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
            "materials": [material],
            "accessors": buffers.accessors,
            "bufferViews": buffers.views,
            "buffers": [{"byteLength": len(buffers.data)}],
        }
        if pictures:
            document |= {"images": pictures, "textures": [{"source": i} for i in range(len(pictures))]}
        return _pack(document, buffers.data)


def _pack(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<4sII", b"glTF", 2, length) + struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def _encoded(picture: Image.Image, kind: str, largest: int) -> bytes:
    picture.thumbnail((largest, largest))
    buffer = io.BytesIO()
    picture.save(buffer, kind, **({"quality": _QUALITY} if kind == "JPEG" else {"compress_level": 1}))
    return buffer.getvalue()
