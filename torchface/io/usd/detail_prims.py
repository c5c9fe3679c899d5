"""Detail maps in USD: the neutral's as the normal of the face's material, the shapes' as further textures of it.

Each is a ``UsdUVTexture`` in the material. Those of shapes are connected to nothing, as ``UsdPreviewSurface`` has no
place for them; the mesh's ``customData`` names them: ``"wrinkleMaps": [{"shape": ..., "texture": name of the prim}]``
in the JSON under ``torchface``.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchface.geometry.meshes.normal_maps import DetailMaps, encode_normals
from torchface.io.images.image_files import encode_png
from torchface.io.usd.material_prims import image_texture

WRINKLE_MAPS = "wrinkleMaps"


def write_wrinkles(
    usd: Any, stage: Any, material: str, detail: DetailMaps, stem: str
) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Adds maps to a material: PNG files by name, which belong beside the layer, and what the mesh notes.

    Args:
        stem: what names of image files begin with.
    """
    images: dict[str, bytes] = {}

    def add(name: str, normals: Tensor) -> Any:
        file = f"{stem}_{name}.png"
        images[file] = encode_png(encode_normals(normals.detach().cpu()))
        return _texture(usd, stage, material, name, file)

    if detail.neutral is not None:
        result = add("neutral_normals", detail.neutral).CreateOutput("rgb", usd.Sdf.ValueTypeNames.Float3)
        surface = usd.UsdShade.Shader(stage.GetPrimAtPath(f"{material}/surface"))
        surface.CreateInput("normal", usd.Sdf.ValueTypeNames.Normal3f).ConnectToSource(result)
    listed = []
    for number, (shape, normals) in enumerate(zip(detail.names, detail.maps, strict=True)):
        add(f"wrinkles_{number}", normals)
        listed.append({"shape": shape, "texture": f"wrinkles_{number}"})
    return images, {WRINKLE_MAPS: listed} if listed else {}


def _texture(usd: Any, stage: Any, material: str, name: str, file: str) -> Any:
    types = usd.Sdf.ValueTypeNames
    texture = image_texture(usd, stage, material, name, file, "raw")
    texture.CreateInput("scale", types.Float4).Set(usd.Gf.Vec4f(2, 2, 2, 1))  # from [0,1] to [-1,1]
    texture.CreateInput("bias", types.Float4).Set(usd.Gf.Vec4f(-1, -1, -1, 0))
    return texture
