"""Materials of a head as UsdPreviewSurface: the mesh's texture or colours, painted images, a plain colour else."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.color_space import to_linear
from torchface.geometry.meshes.normal_maps import DetailMaps, encode_normals
from torchface.io.gltf.part_textures.head_primitives import Surface, surfaces
from torchface.io.images.image_files import encode_png
from torchface.mesh import Mesh
from torchface.part_materials import PartMaterial

PAINTED = "torchface_painted"
"""The key of a material's ``customData`` that marks an image made for a part that had none from the mesh's texture."""


@dataclass(frozen=True, eq=False)
class _Look:
    """What some polygons are made of."""

    name: str  # of the subset and the material
    material: PartMaterial  # roughness, opacity and the plain colour
    image: tuple[str, Tensor] | None = None  # file name and pixels, (3,H,W) or (4,H,W), in the mesh's layout
    colored: bool = False  # by the vertices' colours
    painted: bool = False  # the image is none of the mesh's own


def write_materials(usd: Any, stage: Any, prim: Any, mesh: Mesh, root: str, stem: str) -> tuple[dict[str, bytes], str]:
    """Binds materials to a mesh prim; parts that regions name are ``GeomSubset``s of its polygons.

    Returns PNG files by names that begin with ``stem``, which belong beside the layer, and the path of the face's
    material.
    """
    scope = usd.UsdGeom.Scope.Define(stage, f"{root}/materials").GetPath()
    looks = _polygons_by_look(mesh, stem)
    binding = usd.UsdShade.MaterialBindingAPI.Apply(prim)
    for look, polygons in looks.items():
        made = _material(usd, stage, f"{scope}/{look.name}", look)
        if len(looks) == 1:
            binding.Bind(made)
            break
        indices = usd.Vt.IntArray.FromNumpy(polygons.astype(np.int32))
        subset = binding.CreateMaterialBindSubset(look.name, indices, usd.UsdGeom.Tokens.face)
        usd.UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(made)
    if len(looks) > 1:
        binding.SetMaterialBindSubsetsFamilyType(usd.UsdGeom.Tokens.partition)
    images = dict(look.image for look in looks if look.image is not None)
    return {name: encode_png(image) for name, image in images.items()}, f"{scope}/{next(iter(looks)).name}"


def _polygons_by_look(mesh: Mesh, stem: str) -> dict[_Look, NDArray[np.int64]]:
    """Rows of the polygons of each look; a polygon is made of what its first triangle is made of."""
    looks: list[_Look] = []
    of_triangle = np.zeros(len(mesh.faces), np.int64)
    plain: dict[str, int] = {}
    for surface in surfaces(mesh, mesh.texture is not None):
        number = plain.get(surface.material.name) if _is_plain(surface) else None
        if number is None:
            number = len(looks)
            looks.append(_look(surface, mesh, stem, [look.name for look in looks]))
            if _is_plain(surface):
                plain[surface.material.name] = number
        of_triangle[surface.triangles.numpy()] = number
    first = torch.arange(len(mesh.faces))
    if mesh.polygons is not None:
        triangles = (mesh.polygons >= 0).sum(1) - 2
        first = triangles.cumsum(0) - triangles
    of_polygon = of_triangle[first.cpu().numpy()]
    rows = {look: np.flatnonzero(of_polygon == number) for number, look in enumerate(looks)}
    return {look: polygons for look, polygons in rows.items() if len(polygons)}


def _is_plain(surface: Surface) -> bool:
    return surface.color_source == "material" and (surface.paint is None or surface.paint.image is None)


def _look(surface: Surface, mesh: Mesh, stem: str, used: list[str]) -> _Look:
    names = (surface.material.name, *(f"{surface.material.name}_{number}" for number in range(2, len(used) + 2)))
    name = next(name for name in names if name not in used)
    if surface.color_source == "texture" and mesh.texture is not None:
        return _Look(name, surface.material, (f"{stem}.png", mesh.texture))
    if surface.color_source == "colors":
        return _Look(name, surface.material, colored=True)
    if surface.paint is not None and surface.paint.image is not None:
        return _Look(name, surface.material, (f"{stem}_{name}.png", surface.paint.image), painted=True)
    return _Look(name, surface.material)


def _material(usd: Any, stage: Any, path: str, look: _Look) -> Any:
    shade, types = usd.UsdShade, usd.Sdf.ValueTypeNames
    material = shade.Material.Define(stage, path)
    surface = shade.Shader.Define(stage, f"{path}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", types.Float).Set(look.material.roughness)
    surface.CreateInput("metallic", types.Float).Set(0.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    color, opacity = surface.CreateInput("diffuseColor", types.Color3f), look.material.opacity
    if look.image is not None:
        texture = image_texture(usd, stage, path, "texture", look.image[0], "sRGB")
        color.ConnectToSource(texture.CreateOutput("rgb", types.Float3))
        if look.material.alpha != "OPAQUE" and len(look.image[1]) == 4:
            surface.CreateInput("opacity", types.Float).ConnectToSource(texture.CreateOutput("a", types.Float))
            if look.material.alpha == "MASK":
                surface.CreateInput("opacityThreshold", types.Float).Set(0.5)
    elif look.colored:
        reader = _reader(usd, stage, f"{path}/colors", "UsdPrimvarReader_float3", "displayColor")
        color.ConnectToSource(reader.CreateOutput("result", types.Float3))
    else:
        color.Set(usd.Gf.Vec3f(*to_linear(torch.tensor(look.material.color)).tolist()))
        if opacity < 1:
            surface.CreateInput("opacity", types.Float).Set(opacity)
    if look.painted:
        material.GetPrim().SetCustomDataByKey(PAINTED, True)
    return material


def image_texture(usd: Any, stage: Any, path: str, name: str, image: str, space: str) -> Any:
    """A texture of an image file beside the layer, in the material at a path, by the mesh's texture coordinates."""
    types = usd.Sdf.ValueTypeNames
    texture = usd.UsdShade.Shader.Define(stage, f"{path}/{name}")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", types.Asset).Set(f"./{image}")
    texture.CreateInput("sourceColorSpace", types.Token).Set(space)
    for side in ("wrapS", "wrapT"):
        texture.CreateInput(side, types.Token).Set("repeat")
    reader = _reader(usd, stage, f"{path}/coordinates", "UsdPrimvarReader_float2", "st")  # one a material
    texture.CreateInput("st", types.Float2).ConnectToSource(reader.CreateOutput("result", types.Float2))
    return texture


def _reader(usd: Any, stage: Any, path: str, kind: str, primvar: str) -> Any:
    reader = usd.UsdShade.Shader.Define(stage, path)
    reader.CreateIdAttr(kind)
    reader.CreateInput("varname", usd.Sdf.ValueTypeNames.String).Set(primvar)
    return reader


def write_wrinkles(
    usd: Any, stage: Any, material: str, detail: DetailMaps, stem: str
) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Adds detail maps to a material: PNG files by name, which belong beside the layer, and what the mesh notes.

    The neutral's is the material's normal. Those of shapes are connected to nothing, as ``UsdPreviewSurface`` has no
    place for them; the mesh's ``customData`` names them: ``"wrinkleMaps": [{"shape": ..., "texture": name of the
    prim}]`` in the JSON under ``torchface``.
    """
    images: dict[str, bytes] = {}

    def add(name: str, normals: Tensor) -> Any:
        file = f"{stem}_{name}.png"
        images[file] = encode_png(encode_normals(normals.detach().cpu()))
        return _normal_texture(usd, stage, material, name, file)

    if detail.neutral is not None:
        result = add("neutral_normals", detail.neutral).CreateOutput("rgb", usd.Sdf.ValueTypeNames.Float3)
        surface = usd.UsdShade.Shader(stage.GetPrimAtPath(f"{material}/surface"))
        surface.CreateInput("normal", usd.Sdf.ValueTypeNames.Normal3f).ConnectToSource(result)
    listed = []
    for number, (shape, normals) in enumerate(zip(detail.names, detail.maps, strict=True)):
        add(f"wrinkles_{number}", normals)
        listed.append({"shape": shape, "texture": f"wrinkles_{number}"})
    return images, {"wrinkleMaps": listed} if listed else {}


def _normal_texture(usd: Any, stage: Any, material: str, name: str, file: str) -> Any:
    types = usd.Sdf.ValueTypeNames
    texture = image_texture(usd, stage, material, name, file, "raw")
    texture.CreateInput("scale", types.Float4).Set(usd.Gf.Vec4f(2, 2, 2, 1))  # from [0,1] to [-1,1]
    texture.CreateInput("bias", types.Float4).Set(usd.Gf.Vec4f(-1, -1, -1, 0))
    return texture
