"""Materials and images of a head's primitives."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchface.color_space import to_linear
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.part_colors.surfaces import Surface
from torchface.io.gltf.region_materials import SKIN
from torchface.io.images.image_files import encode_png
from torchface.mesh import Mesh


class MaterialWriter:
    """Collects the materials of one mesh; ``fields`` is what the document gets of them.

    Args:
        mesh: on the CPU.
        buffers: where images go.
    """

    def __init__(self, mesh: Mesh, buffers: BufferWriter) -> None:
        self.mesh, self.buffers = mesh, buffers
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
            self._textures[id(image)] = self.buffers.texture(self.fields, encode_png(image), name=name)
        return self._textures[id(image)]
