"""A registered face at its template's place, with the template's material where the scan shows none."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.geometry.meshes.operators import components
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.geometry.similarity import similarity_transform
from torchface.mesh import Mesh
from torchface.part_materials import part_material

_SEEN = 0.5
_SEAM = 4


def in_place_of(mesh: Mesh, template: Mesh, weights: Tensor | None = None) -> Mesh:
    """A mesh rotated and translated, without scaling, to where a template of the same topology is.

    Args:
        mesh: V vertices.
        template: V vertices.
        weights: how much each vertex counts, (V,); equal if absent.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> moved = in_place_of(head.with_vertices(head.vertices + 50), head)
        >>> torch.allclose(moved.vertices, head.vertices, atol=1e-3)
        True
    """
    own, other = mesh.vertices.double(), template.vertices.double()
    pose = similarity_transform(own[None], other[None], None if weights is None else weights[None], scale=False)
    return mesh.with_vertices(pose.apply(own[None])[0].to(mesh.vertices))


def hidden_parts(mesh: Mesh, matched: Tensor) -> Tensor:
    """The vertices that the scan has not shown of what is no skin, (V,) bool.

    They are those of parts that share no vertex with the largest, such as eyeballs, hair or a shirt, unless the scan
    shows half of the part, and those of regions that by their names are no skin, such as ``mouth_interior``.

    Args:
        mesh: V vertices.
        matched: vertices that the scan shows, (V,) bool.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> hidden = hidden_parts(head, head.annotations.regions["face"])  # of a scan of closed eyes and lips
        >>> bool(hidden[head.annotations.regions["eyeball_left"]].all())
        True
    """
    label = components(mesh.faces.cpu(), len(mesh.vertices))
    size = label.bincount().double()
    shown = torch.zeros_like(size).index_add_(0, label, matched.cpu().double()) / size.clamp(min=1)
    hidden = shown < _SEEN
    hidden[size.argmax()] = False
    result = hidden[label]
    for name, region in mesh.regions.items():
        if part_material(name) is not None:  # a scan that looks into the mouth has its colours
            result |= region.cpu() & ~matched.cpu()
    return result


def with_template_skin(mesh: Mesh, template: Mesh, hidden: Tensor) -> Mesh:
    """A mesh whose hidden parts have the template's colours; the mesh's where the template has none.

    Args:
        mesh: registered, with the template's topology and texture coordinates.
        template: with a texture or vertex colours.
        hidden: vertices (V,) bool.

    Example:
        >>> from dataclasses import replace
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> black, white = (replace(head, colors=torch.full_like(head.vertices, grey)) for grey in (0.0, 1.0))
        >>> eyeball = head.annotations.regions["eyeball_left"]
        >>> bool((with_template_skin(black, white, eyeball).colors[:, 0] == eyeball).all())
        True
    """
    if not hidden.any():
        return mesh
    colors, texture = mesh.colors, mesh.texture
    if colors is not None and template.colors is not None:
        colors = torch.where(hidden[:, None], template.colors.to(colors), colors)
    if texture is not None and template.texture is not None and mesh.uvs is not None and mesh.uv_faces is not None:
        height, width = texture.shape[1:]
        texels = rasterise_uvs(mesh.uvs, mesh.uv_faces, height, width)
        inside = torch.zeros(height * width)
        inside[texels.texels[hidden[mesh.faces].all(1)[texels.triangles]]] = 1
        seam = inside.view(1, height, width) > 0
        for size, pad in (((2 * _SEAM + 1, 1), (_SEAM, 0)), ((1, 2 * _SEAM + 1), (0, _SEAM))):  # a square, in two
            seam = torch.nn.functional.max_pool2d(seam.float(), size, 1, pad) > 0
        taken = (inside.view(height, width) > 0) | (seam[0] & ~texels.mask())
        own = torch.nn.functional.interpolate(
            template.texture[None].to(texture), (height, width), mode="bilinear", align_corners=False, antialias=True
        )[0]
        texture = torch.where(taken, own, texture)
    return replace(mesh, colors=colors, texture=texture)
