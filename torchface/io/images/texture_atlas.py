"""The images and plain colours of a scene's materials side by side in the one image that a mesh has."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from torchface.geometry.meshes.uv_seams import merge_equal_rows
from torchface.mesh import Mesh

_BORDER = 2  # texels round each image, so that bilinear samples at its edge do not meet its neighbour
_SWATCH = 4  # texels of a side of a plain colour
_LARGEST = 8192  # texels of a side


@dataclass(frozen=True, eq=False)
class Look:
    """What covers some triangles.

    Args:
        image: (3,H,W) in [0,1], first row on top; none for the plain colour.
        color: sRGB in [0,1], (3,), by which the image is multiplied.
    """

    image: Tensor | None
    color: Tensor = field(default_factory=lambda: torch.ones(3))

    def texels(self) -> Tensor:
        """The image in its colour."""
        plain = torch.ones(3, _SWATCH, _SWATCH) if self.image is None else self.image
        return plain if bool((self.color == 1).all()) else plain * self.color[:, None, None]


MAX_TEXELS = 2**27  # of all images of a scene


def with_used_looks(mesh: Mesh, look: Tensor, looks: Sequence[Look], images_only: bool) -> Mesh:
    """:func:`with_looks` of those that occur; with ``images_only`` plain colours get no place, and without images
    nothing changes."""
    painted = torch.tensor([one.image is not None for one in looks])
    if images_only and not bool(painted.all()):
        if not bool(painted.any()):
            return mesh
        most = int(torch.where(painted, look.bincount(minlength=len(looks)), -1).argmax())
        look = torch.where(painted[look], look, most)
    used, look = look.unique(return_inverse=True)
    return with_looks(mesh, look, [looks[i] for i in used.tolist()])


def with_looks(mesh: Mesh, look: Tensor, looks: Sequence[Look]) -> Mesh:
    """The mesh with one image of its looks, a row (F,) a triangle, and their layout; unchanged with one look.

    A triangle whose coordinates lie in another tile of a repeated image shows the same texels. One that reaches over a
    tile's border shows the border's texels from there on.
    """
    if len(looks) == 1:
        one = looks[0]
        return mesh if one.image is None else replace(mesh, texture=one.texels())
    images = [one.texels() for one in looks]
    places, atlas = _packed(images)
    if mesh.uvs is None or mesh.uv_faces is None:
        mesh = replace(mesh, uvs=torch.full((1, 2), 0.5), uv_faces=torch.zeros_like(mesh.faces))
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    tile = mesh.uvs[mesh.uv_faces].double().mean(1).floor().long()
    corner = torch.cat(
        [mesh.uv_faces[..., None], look[:, None, None].expand(-1, 3, 1), tile[:, None].expand(-1, 3, 2)], -1
    )
    of, first = merge_equal_rows(corner.reshape(-1, 4).numpy())
    rows = corner.reshape(-1, 4)[torch.from_numpy(first)]
    local = (mesh.uvs[rows[:, 0]].double() - rows[:, 2:]).clamp(0, 1)
    plain = torch.tensor([one.image is None for one in looks])[rows[:, 1]]
    local = torch.where(plain[:, None], 0.5, local)
    size = torch.tensor([[image.shape[2], image.shape[1]] for image in images]).double()[rows[:, 1]]
    texel = torch.stack([local[:, 0], 1 - local[:, 1]], 1) * size + torch.tensor(places).double()[rows[:, 1]]
    at = texel / torch.tensor([atlas.shape[2], atlas.shape[1]])
    uvs = torch.stack([at[:, 0], 1 - at[:, 1]], 1).to(mesh.uvs)
    return replace(mesh, uvs=uvs, uv_faces=torch.from_numpy(of).reshape(-1, 3), texture=atlas)


def _packed(images: list[Tensor]) -> tuple[list[tuple[int, int]], Tensor]:
    """The column and row of each image in one, and that one; all are made smaller where it would be too large."""
    while True:
        sizes = [(image.shape[2] + 2 * _BORDER, image.shape[1] + 2 * _BORDER) for image in images]
        places, width, height = _shelves(sizes)
        if max(width, height) <= _LARGEST:
            break
        share = 0.95 * _LARGEST / max(width, height)
        # Plain colours and thin strips keep their few texels; what is wide shrinks until all fits.
        small = [[max(min(side, _SWATCH), int(share * side)) for side in image.shape[1:]] for image in images]
        images[:] = [
            torch.nn.functional.interpolate(image[None], size=size, mode="area")[0]
            for image, size in zip(images, small, strict=True)
        ]
    atlas = torch.zeros(3, height, width)
    for image, (x, y) in zip(images, places, strict=True):
        edged = torch.nn.functional.pad(image[None], (_BORDER,) * 4, mode="replicate")[0]
        atlas[:, y - _BORDER : y + image.shape[1] + _BORDER, x - _BORDER : x + image.shape[2] + _BORDER] = edged
    return places, atlas


def _shelves(sizes: Sequence[tuple[int, int]]) -> tuple[list[tuple[int, int]], int, int]:
    """Where the images of these widths and heights begin, inside their borders, and the width and height of all."""
    width = max(max(w for w, _ in sizes), int(np.ceil(np.sqrt(sum(w * h for w, h in sizes)))))
    places = [(0, 0)] * len(sizes)
    x = y = shelf = 0
    for number in sorted(range(len(sizes)), key=lambda number: -sizes[number][1]):
        w, h = sizes[number]
        if x + w > width:
            x, y = 0, y + shelf
        if x == 0:
            shelf = h
        places[number] = (x + _BORDER, y + _BORDER)
        x += w
    return places, width, y + shelf
