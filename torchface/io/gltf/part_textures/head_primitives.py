"""A head cut into the primitives that engines draw: skin, eyes, teeth, shells, each of one material."""

from dataclasses import dataclass
from typing import Literal

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import components
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.io.gltf.part_textures.iris_texture import Paint, painted, painted_eye, stands_alone
from torchface.mesh import Mesh
from torchface.part_materials import EYEBALL, EYELASHES, PARTS, SKIN, PartMaterial, part_material

_SPACING = 1.1  # millimetres between the hairs of one card
# Fractions: of the spacing, the width of a root; of the card, the shortest hair; of the spacing, how far tips lean.
_ROOT, _MIN_LENGTH, _LEAN = 0.34, 0.55, 0.9
_SIDE, _DENSE = 1024, 0.6


def painted_lashes(mesh: Mesh, triangles: Tensor, material: PartMaterial) -> Paint:
    """Hairs of a material's colour for lashes, rows (K,) of the faces, whose cards each begin at a lid."""
    faces = mesh.faces[triangles]
    ids, local = faces.unique(return_inverse=True)
    card = components(local.reshape(-1, 3), len(ids))
    points = mesh.vertices.detach()[ids].double()
    rest = torch.ones(len(mesh.vertices), dtype=torch.bool)
    rest[ids] = False
    distance = torch.from_numpy(cKDTree(mesh.vertices.detach()[rest].numpy()).query(points.numpy())[0])
    cards = torch.zeros(int(card.max()) + 1, dtype=distance.dtype)
    nearest = cards.scatter_reduce(0, card, distance, "amin", include_self=False)
    longest = cards.scatter_reduce(0, card, distance, "amax", include_self=False) - nearest
    values = torch.zeros(len(mesh.vertices), 3, dtype=torch.float64)
    values[ids, 0] = (distance - nearest[card]) / longest[card].clamp(min=1e-9)
    values[ids, 1] = _along(points, card)
    values[ids, 2] = card.double()
    color = torch.tensor(material.color, dtype=torch.float64)

    def hairs(at: Tensor) -> Tensor:
        return torch.cat([color.expand(len(at), 3), _opacity(at)[:, None]], dim=1)

    paint = painted(mesh, triangles, values, hairs, _SIDE)
    if paint.colors is None:
        return paint
    faded = _DENSE * (1 - values[:, :1])  # vertices are too few for hairs
    return Paint(None, torch.cat([color.expand(len(values), 3), faded], dim=1).float())


def _along(points: Tensor, card: Tensor) -> Tensor:
    """Where on its card each point lies along the lid, millimetres, (K,)."""
    along = torch.zeros(len(points), dtype=points.dtype)
    for number in range(int(card.max()) + 1):  # one card each
        centred = points[card == number]
        centred = centred - centred.mean(0)
        along[card == number] = centred @ torch.linalg.svd(centred, full_matrices=False).Vh[0]
    return along


def _opacity(at: Tensor) -> Tensor:
    """1 on a hair, 0 between, of values (N,3): root to tip, millimetres along the lid, card."""
    tip, along, card = at.unbind(1)
    position = along / _SPACING + _LEAN * (tip * (0.7 + 0.3 * torch.sin(1.7 * along))) + 0.37 * card.round()
    hair = position.floor()
    random = torch.frac(torch.sin(hair * 12.9898 + card.round() * 78.233) * 43758.5453).abs()
    length = _MIN_LENGTH + (1 - _MIN_LENGTH) * random
    width = 0.5 * _ROOT * (1 - tip / length).clamp(0, 1).sqrt()
    offset = (position - hair - 0.5 + 0.2 * (random - 0.5)).abs()
    return ((width - offset) / 0.06 + 0.5).clamp(0, 1) * (tip < length)


_RASTER = 512
_MIN_OWN_FRACTION = 0.5

ColorSource = Literal["texture", "colors", "material"]


@dataclass(frozen=True, eq=False)
class Surface:
    """The triangles of one primitive."""

    triangles: Tensor  # rows of the mesh's faces, ascending, (K,)
    material: PartMaterial  # what they are made of
    color_source: ColorSource  # where their colour is: in the mesh's texture, in its vertex colours, or in the material
    part: str | None = None  # the region of an eyeball that rotates about a node of its own
    paint: Paint | None = None  # of an eyeball or lashes whose colour is in the material


def surfaces(mesh: Mesh, has_image: bool) -> list[Surface]:
    """The primitives of a mesh, skin first; one where no region names a part.

    A part has the mesh's texture where texels are its own. Texture coordinates beyond the unit square name other
    images (UDIM), which a mesh does not have, and charts that lie on those of another part's have lost theirs.
    """
    groups = _groups(mesh)
    if len(groups) == 1 and groups[0][0] is SKIN:
        everything = torch.arange(len(mesh.faces))
        return [Surface(everything, SKIN, _color_source(mesh, mesh.texture is not None and mesh.uvs is not None))]
    textured = _with_own_texels(mesh, groups) if has_image else torch.zeros(len(mesh.faces), dtype=torch.bool)
    cut: list[Surface] = []
    for material, part, triangles in groups:
        if material is SKIN:
            pieces = [(triangles[textured[triangles]], True), (triangles[~textured[triangles]], False)]
            cut += [
                Surface(rows, SKIN, _color_source(mesh, owns and mesh.texture is not None))
                for rows, owns in pieces
                if len(rows)
            ]
        elif mesh.texture is not None and bool(textured[triangles].all()):
            cut.append(Surface(triangles, material, "texture", part))
        elif material is EYEBALL:
            layers = painted_eye(mesh, triangles)
            cut += [Surface(rows, made, "material", part, paint) for rows, made, paint in layers if len(rows)]
        else:
            paint = painted_lashes(mesh, triangles, material) if material is EYELASHES else None
            cut.append(Surface(triangles, material, "material", part, paint))
    return cut


def parts_without_texels(mesh: Mesh) -> Tensor:
    """Triangles (F,) of parts other than skin that a texture in the mesh's layout does not show; see `surfaces`."""
    groups = _groups(mesh)
    textured = _with_own_texels(mesh, groups)
    bare = torch.zeros(len(mesh.faces), dtype=torch.bool)
    for material, _, triangles in groups:
        if material is not SKIN and not bool(textured[triangles].all()):
            bare[triangles] = True
    return bare


def _color_source(mesh: Mesh, textured: bool) -> ColorSource:
    if textured:
        return "texture"
    return "material" if mesh.colors is None else "colors"


def _groups(mesh: Mesh) -> list[tuple[PartMaterial, str | None, Tensor]]:
    """Material, eyeball's region and triangles of each part, skin first; none is empty."""
    free = torch.ones(len(mesh.faces), dtype=torch.bool)
    parts: list[tuple[PartMaterial, str | None, Tensor]] = []
    for material in PARTS:  # a triangle takes the first that it may be
        together = torch.zeros_like(free)
        for name, mask in mesh.regions.items():
            if part_material(name) is not material:
                continue
            inside = mask.cpu()[mesh.faces].all(1) & free
            if material is EYEBALL and inside.any() and stands_alone(mesh.faces, inside):
                parts.append((material, name, inside.nonzero()[:, 0]))
                free &= ~inside
            else:
                together |= inside
        if together.any():
            parts.append((material, None, together.nonzero()[:, 0]))
            free &= ~together
    return [(SKIN, None, free.nonzero()[:, 0]), *parts] if free.any() else parts


def _with_own_texels(mesh: Mesh, groups: list[tuple[PartMaterial, str | None, Tensor]]) -> Tensor:
    """Triangles (F,) in the unit square whose part is the one that a texture baked in this layout shows there."""
    if mesh.uvs is None or mesh.uv_faces is None:
        return torch.zeros(len(mesh.faces), dtype=torch.bool)
    middle = mesh.uvs[mesh.uv_faces].double().mean(1)
    inside = ((middle >= 0) & (middle <= 1)).all(1)
    texels = rasterise_uvs(mesh.uvs, mesh.uv_faces, _RASTER, _RASTER)
    owner = torch.full((_RASTER * _RASTER,), -1)
    owner[texels.texels] = texels.triangles
    column = (middle[:, 0] * _RASTER).long().clamp(0, _RASTER - 1)
    row = ((1 - middle[:, 1]) * _RASTER).long().clamp(0, _RASTER - 1)
    above = owner[row * _RASTER + column]
    group = torch.full((len(mesh.faces) + 1,), -1)  # the last answers for texels that no triangle covers
    for number, (_, _, triangles) in enumerate(groups):
        group[triangles] = number
    textured = torch.zeros(len(mesh.faces), dtype=torch.bool)
    for number, (_, _, triangles) in enumerate(groups):
        here = triangles[inside[triangles] & (above[triangles] >= 0)]
        if len(here) and float((group[above[here]] == number).double().mean()) > _MIN_OWN_FRACTION:
            textured[triangles] = inside[triangles]
    return textured
