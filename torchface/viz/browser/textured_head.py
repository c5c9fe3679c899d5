"""A head with its texture or vertex colours and its normal map as the bytes of a ``.glb`` for the page."""

from __future__ import annotations

import io
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from torchface.color_space import to_linear
from torchface.geometry.meshes.normal_maps import encode_normals
from torchface.geometry.meshes.uv_seams import split_at_seams
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.container import glb_pieces
from torchface.io.gltf.part_colors.surfaces import ColorSource, Surface
from torchface.io.gltf.primitive_writing import PrimitiveWriter
from torchface.io.gltf.region_materials import SKIN
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import CLAY
from torchface.rendering.compositing import to_pillow

_MAX_SIDE = 2048
_MAX_NORMALS_SIDE = 1024
_QUALITY = 90
_ROUGHNESS = 0.72


class TexturedHead:
    """A mesh's material, prepared once; positions, and a normal map where there is one, go in each time.

    Args:
        mesh: its texture is used where it has one, else its vertex colours, else clay.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh = mesh.to("cpu")
        uv_faces = None if mesh.uv_faces is None else mesh.uv_faces.numpy()
        self._split = split_at_seams(len(mesh.vertices), mesh.faces.numpy(), uv_faces)
        textured = mesh.texture is not None and mesh.uvs is not None
        source: ColorSource = "texture" if textured else "material" if mesh.colors is None else "colors"
        self._surface = Surface(torch.arange(len(mesh.faces)), SKIN, source)
        self._image = _encoded(mesh.texture, "JPEG", _MAX_SIDE) if textured and mesh.texture is not None else None
        self._color = [*to_linear(torch.tensor(CLAY)).tolist(), 1.0] if source == "material" else None

    def glb(self, vertices: Tensor, normal_map: Tensor | None = None) -> bytes:
        """A ``.glb`` of the mesh, in metres.

        Args:
            vertices: (V,3), millimetres.
            normal_map: unit vectors in tangent space, (3,H,W); left out where the mesh has no UVs.
        """
        buffers = BufferWriter()
        mesh = self._mesh.with_vertices(vertices.detach().cpu().float())
        primitive = PrimitiveWriter(mesh, self._split, buffers).add(self._surface, 0, torch.zeros(3))
        shading: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": _ROUGHNESS}
        material: dict[str, Any] = {"pbrMetallicRoughness": shading, "doubleSided": True}
        root: dict[str, Any] = {
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
            "materials": [material],
        }
        if self._image is not None:
            shading["baseColorTexture"] = {"index": buffers.texture(root, self._image, "image/jpeg")}
        elif self._color is not None:
            shading["baseColorFactor"] = self._color
        if normal_map is not None and mesh.uvs is not None:
            image = _encoded(encode_normals(normal_map.cpu().float()), "PNG", _MAX_NORMALS_SIDE)
            material["normalTexture"] = {"index": buffers.texture(root, image)}
        return b"".join(glb_pieces(root, buffers))


def _encoded(image: Tensor, kind: str, max_side: int) -> bytes:
    shrunk: Image.Image = to_pillow(image)
    shrunk.thumbnail((max_side, max_side))
    file = io.BytesIO()
    shrunk.save(file, kind, **({"quality": _QUALITY} if kind == "JPEG" else {"compress_level": 1}))
    return file.getvalue()
