"""A head with its texture, or its vertex colours, as the bytes of a small glTF file."""

from __future__ import annotations

import io
import json
import struct

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from torchface.io.gltf.primitives import decode_srgb
from torchface.mesh import Mesh

_FLOAT, _UNSIGNED = 5126, 5125
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963
_LARGEST_SIDE = 2048
_QUALITY = 90


class Skin:
    """A mesh's look, prepared once; positions go in each time.

    Args:
        mesh: with ``texture`` and ``uvs``, or with ``colors``.
    """

    def __init__(self, mesh: Mesh) -> None:
        mesh = mesh.to("cpu")
        self._textured = mesh.texture is not None and mesh.uvs is not None
        if self._textured:
            assert mesh.uvs is not None
            assert mesh.uv_faces is not None
            corners = mesh.faces * len(mesh.uvs) + mesh.uv_faces
            unique, indices = corners.unique(return_inverse=True)
            self._vertex_of = unique // len(mesh.uvs)
            uvs = mesh.uvs[unique % len(mesh.uvs)]
            look = torch.stack([uvs[:, 0], 1 - uvs[:, 1]], dim=1).float().numpy()
            self._image = _jpeg(mesh.texture)
        else:
            self._vertex_of, indices = torch.arange(len(mesh.vertices)), mesh.faces
            colors = torch.tensor([[0.8] * 3]).expand(len(mesh.vertices), 3) if mesh.colors is None else mesh.colors
            # glTF wants vertex colours linear, the mesh holds them as a picture does.
            look = decode_srgb(colors.clamp(0, 1).float().numpy())
            self._image = b""
        self._look, self._indices = look, indices.numpy().astype(np.uint32)

    @staticmethod
    def of(mesh: Mesh) -> Skin | None:
        """The mesh's skin, or nothing where it is plain clay."""
        return Skin(mesh) if (mesh.texture is not None and mesh.uvs is not None) or mesh.colors is not None else None

    def glb(self, vertices: Tensor) -> bytes:
        """A ``.glb`` of the mesh at ``vertices`` (V,3), in their own unit."""
        positions = vertices.detach().cpu().float()[self._vertex_of].numpy()
        chunks = [positions.tobytes(), self._look.tobytes(), self._indices.tobytes(), self._image]
        views, start = [], 0
        for chunk, target in zip(chunks, (_VERTEX_BUFFER, _VERTEX_BUFFER, _INDEX_BUFFER, None), strict=True):
            if chunk:
                views.append(
                    {"buffer": 0, "byteOffset": start, "byteLength": len(chunk)}
                    | ({"target": target} if target else {})
                )
            start += len(chunk)
        binary = b"".join(chunks)
        binary += b"\0" * (-len(binary) % 4)
        document = self._document(positions, views, len(binary))
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + len(binary)
        header = struct.pack("<4sII", b"glTF", 2, length) + struct.pack("<I4s", len(text), b"JSON")
        return header + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary

    def _document(self, positions: np.ndarray, views: list[dict], length: int) -> dict:
        material: dict = {"metallicFactor": 0.0, "roughnessFactor": 0.72}
        look = "TEXCOORD_0" if self._textured else "COLOR_0"
        document = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0, look: 1}, "indices": 2, "material": 0}]}],
            "materials": [{"pbrMetallicRoughness": material, "doubleSided": True}],
            "accessors": [
                {
                    "bufferView": 0,
                    "componentType": _FLOAT,
                    "count": len(positions),
                    "type": "VEC3",
                    "min": positions.min(0).tolist(),
                    "max": positions.max(0).tolist(),
                },
                {
                    "bufferView": 1,
                    "componentType": _FLOAT,
                    "count": len(self._look),
                    "type": "VEC2" if self._textured else "VEC3",
                },
                {"bufferView": 2, "componentType": _UNSIGNED, "count": self._indices.size, "type": "SCALAR"},
            ],
            "bufferViews": views,
            "buffers": [{"byteLength": length}],
        }
        if self._textured:
            material["baseColorTexture"] = {"index": 0}
            document |= {"textures": [{"source": 0}], "images": [{"bufferView": 3, "mimeType": "image/jpeg"}]}
        return document


def _jpeg(texture: Tensor | None) -> bytes:
    assert texture is not None
    pixels = (texture.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    picture = Image.fromarray(pixels)
    picture.thumbnail((_LARGEST_SIDE, _LARGEST_SIDE))
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=_QUALITY)
    return buffer.getvalue()
