"""Primitives and their morph targets: vertices split at seams and at the borders of parts."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.color_space import to_linear
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.uv_seams import Split
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.part_textures.head_primitives import Surface
from torchface.io.images.image_files import encode_jpeg, encode_png
from torchface.io.length_units import millimetres_per
from torchface.mesh import Mesh
from torchface.part_materials import SKIN

MIN_MOVE = 1e-4  # millimetres; a vertex that a shape moves less than this is written as not moved
_MIN_ROTATION = 1 / 256  # radians; a normal that a shape rotates less than this is written as unchanged
_MAX_EXACT_ID = 2**24


class PrimitiveWriter:
    """Writes the primitives of one mesh into a buffer; the first has glTF's tangents (F,3,4) where it has a normal
    map."""

    def __init__(
        self, mesh: Mesh, split: Split, buffers: BufferWriter, tangents: NDArray[np.float32] | None = None
    ) -> None:
        self.mesh, self.split, self.buffers, self.tangents = mesh, split, buffers, tangents
        self.normals = shading_normals(mesh.vertices.detach().double(), mesh.faces)
        self._written: list[tuple[dict[str, Any], NDArray[np.int64]]] = []

    def add(self, surface: Surface, material: int, origin: Tensor) -> dict[str, Any]:
        """A primitive without morph targets yet, about the node's place (3,), millimetres."""
        triangles = self.split.triangles[surface.triangles.numpy()]
        rows, local = np.unique(triangles, return_inverse=True)
        local = local.reshape(-1, 3)
        if not self._written:  # vertices of no face go with the first
            rows = np.append(rows, np.setdiff1d(np.arange(len(self.split.vertex_of)), self.split.triangles))
        vertices = self.split.vertex_of[rows]
        attributes = self._attributes(surface, rows, vertices, origin)
        if self.tangents is not None and not self._written:
            table = np.tile(np.array([1, 0, 0, 1], np.float32), (len(rows), 1))
            table[local] = self.tangents[surface.triangles.numpy()]
            attributes["TANGENT"] = self.buffers.vertices(table)
        primitive: dict[str, Any] = {
            "attributes": attributes,
            "indices": self.buffers.triangles(local),
            "material": material,
        }
        if surface.paint is not None:  # so that readers do not take it for a texture of the mesh
            primitive["extras"] = {"torchface": {"painted": True}}
        self._written.append((primitive, vertices))
        return primitive

    def add_targets(self, deltas: Tensor) -> None:
        """Morph targets (N,V,3), millimetres, for all primitives: positions and normals."""
        for delta in deltas.detach().cpu().double():  # one shape at a time: all normals at once would fill the memory
            moved, rotated = shown_motion(self.mesh, self.normals, delta)
            for primitive, vertices in self._written:
                target = {
                    "POSITION": self.buffers.deltas(metres(moved[vertices])),
                    "NORMAL": self.buffers.deltas(rotated[vertices]),
                }
                primitive.setdefault("targets", []).append(target)

    def _attributes(
        self, surface: Surface, rows: NDArray[np.int64], vertices: NDArray[np.int64], origin: Tensor
    ) -> dict[str, int]:
        mesh, buffers = self.mesh, self.buffers
        places = (mesh.vertices.detach().double() - origin.double()).numpy()[vertices]
        attributes = {
            "POSITION": buffers.vertices(metres(places)),
            "NORMAL": buffers.vertices(self.normals.float().numpy()[vertices]),
        }
        if mesh.uvs is not None and self.split.uv_of is not None:
            uvs = mesh.uvs.detach().float().numpy()[self.split.uv_of[rows]]
            attributes["TEXCOORD_0"] = buffers.vertices(np.stack([uvs[:, 0], 1 - uvs[:, 1]], axis=1))
        if mesh.colors is not None:
            light = to_linear(mesh.colors.detach().float().clamp(0, 1)).numpy()[vertices]
            # Beside a texture COLOR_0 would be multiplied with it; under this name viewers leave it alone.
            attributes["COLOR_0" if surface.color_source == "colors" else "_COLOR"] = buffers.vertices(light)
        if surface.paint is not None and surface.paint.colors is not None:
            painted = surface.paint.colors[vertices]
            light = torch.cat([to_linear(painted[:, :3]), painted[:, 3:]], dim=1).numpy()
            attributes["COLOR_0"] = buffers.vertices(light)
        if len(mesh.vertices) <= _MAX_EXACT_ID:
            attributes["_VERTEX_ID"] = buffers.vertices(vertices.astype(np.float32))
        return attributes


def metres(millimetres: NDArray[Any]) -> NDArray[np.float32]:
    """Lengths as glTF has them."""
    return (millimetres / np.float64(millimetres_per("m"))).astype(np.float32)


def shading_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (V,3), also where a vertex is loose or its triangles have no area."""
    normals = vertex_normals(vertices, faces)
    normals[normals.norm(dim=1) < 0.5] = torch.tensor([0.0, 0.0, 1.0], dtype=normals.dtype)  # loose, or without area
    return normals


def shown_motion(mesh: Mesh, normals: Tensor, delta: Tensor) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How far a shape (V,3) float64 moves positions and normals (V,3); 0 where that is too little to show."""
    moved = delta.float().numpy()
    rotated = (shading_normals(mesh.vertices.detach().double() + delta, mesh.faces) - normals).float().numpy()
    return (
        moved * (np.einsum("ij,ij->i", moved, moved)[:, None] >= MIN_MOVE * MIN_MOVE),
        rotated * (np.einsum("ij,ij->i", rotated, rotated)[:, None] >= _MIN_ROTATION * _MIN_ROTATION),
    )


class MaterialWriter:
    """Collects the ``fields`` of one mesh's materials; images of three channels are JPEG, which is smaller, or all
    PNG."""

    def __init__(self, mesh: Mesh, buffers: BufferWriter, jpeg: bool = False) -> None:
        self.mesh, self.buffers, self._jpeg = mesh, buffers, jpeg
        self.fields: dict[str, Any] = {"materials": []}
        self._textures: dict[int, int] = {}

    def add(self, surface: Surface) -> int:
        """The index of the material of a primitive."""
        shading: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": surface.material.roughness}
        material: dict[str, Any] = {"name": surface.material.name, "doubleSided": True}
        if surface.color_source == "texture":
            assert self.mesh.texture is not None
            shading["baseColorTexture"] = {"index": self._texture(self.mesh.texture, "skin")}
        elif surface.paint is not None and surface.paint.image is not None:
            name = f"{surface.part}_{surface.material.name}" if surface.part else surface.material.name
            shading["baseColorTexture"] = {"index": self._texture(surface.paint.image, name)}
        elif surface.color_source == "material" and surface.paint is None:
            shading["baseColorFactor"] = [*self._plain(surface), surface.material.opacity]
        if surface.material.alpha != "OPAQUE":
            material["alphaMode"] = surface.material.alpha
        material["pbrMetallicRoughness"] = shading
        materials = self.fields["materials"]
        if material in materials and surface.material is not SKIN:  # normal maps are on the first skin material alone
            return materials.index(material)
        materials.append(material)
        return len(materials) - 1

    def _plain(self, surface: Surface) -> list[float]:
        """One colour in light; skin without texels takes the mean of the texture."""
        color = torch.tensor(surface.material.color)
        if surface.material is SKIN and self.mesh.texture is not None:
            color = self.mesh.texture.float().mean((1, 2))
        return [float(value) for value in np.round(to_linear(color.float()).numpy(), 4)]

    def _texture(self, image: Tensor, name: str) -> int:
        if id(image) not in self._textures:
            jpeg = self._jpeg and len(image) == 3
            data, kind = (encode_jpeg(image), "image/jpeg") if jpeg else (encode_png(image), "image/png")
            self._textures[id(image)] = self.buffers.texture(self.fields, data, kind, name)
        return self._textures[id(image)]
