"""Wrinkle maps for a rig, baked from an actor's displacements."""

import torch
from torch import Tensor

from torchface.enhancement.detail.detail_encodings import DisplacementDetail
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.geometry.meshes.region_maps import RegionMaps
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.modeling.detail.normal_map_baking import NormalMap, bake_normal_map, dilate
from torchface.progress import Progress

_MASK_SHARE = 4  # a mask is smooth: it has a quarter of the maps' texels a side
_LEAST_MASK = 64


def bake_region_maps(
    mesh: Mesh,
    model: Mesh,
    displacements: Tensor,
    shares: Tensor,
    regions: tuple[str, ...],
    scale: float,
    size: int,
    progress: Progress,
) -> RegionMaps:
    """Bakes the actor's face at rest, and with each map of displacements everywhere at 1.

    Args:
        displacements: of the maps, (M,3,V), millimetres along two tangents and the normal of the model's neutral.
        shares: of the regions in the rig's vertices, (R,N).
        scale: from the rig's millimetres to the model's.
    """
    still = Similarity(
        torch.ones(1, dtype=torch.float64),
        torch.eye(3, dtype=torch.float64)[None],
        torch.zeros(1, 3, dtype=torch.float64),
    )
    detail = DisplacementDetail(model.vertices, model.faces)
    count = len(displacements)

    def baked(number: int, vertices: Tensor) -> NormalMap:
        progress("baking maps", number, count + 1)
        return bake_normal_map(mesh, model.with_vertices(vertices), size, alignment=still)

    rest = baked(0, model.vertices)
    normals, heights = [], []
    for number, one in enumerate(displacements, start=1):  # a bake is minutes of rays at large sizes
        shown = baked(number, detail.compose(model.vertices[None], one.flatten()[None])[0])
        both = rest.hit & shown.hit
        normals.append(torch.where(both, shown.normals, rest.normals))
        heights.append(torch.where(both, shown.heights - rest.heights, 0.0) / scale)
    progress("baking maps", count + 1, count + 1)
    masks = _masks(mesh, shares, max(_LEAST_MASK, size // _MASK_SHARE))
    return RegionMaps(regions, torch.stack(normals), torch.stack(heights), masks, rest.normals)


def _masks(mesh: Mesh, shares: Tensor, size: int) -> Tensor:
    """Values (R,N) of the vertices in texture space, (R,size,size), grown over the whole texture."""
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    texels = rasterise_uvs(mesh.uvs, mesh.uv_faces, size, size)
    image = torch.zeros(len(shares), size * size)
    image[:, texels.texels] = texels.interpolate(shares.T.double(), mesh.faces).T.float()
    return dilate(image.view(-1, size, size), texels.mask(), size).clamp(0, 1)
