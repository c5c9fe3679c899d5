"""Colour of the eyes: found in photographs, and given to painted eyeballs."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.mesh import Mesh
from torchface.part_materials import EYEBALL, part_material

IRIS_WIDTH = 11.7
"""Of people's irises, millimetres."""

_MIN_RADIUS, _MIN_RING, _RING = 2.5, 6, (0.45, 0.8)  # pixels, pixels, radii
_SHIFTS = (0.0, -0.4, 0.4, -0.8, 0.8)  # radii from midway between the lids, where irises of unknown place may be
_DARKEST, _LARGE = 0.07, 0.4  # of the largest iris' radius: in which photographs colours count
_PURPLE = 0.9  # of the lesser of red and blue: what green an iris has at least
_WHITE = 0.72  # mean of the channels from which an eyeball's texel is no iris
_DIM, _BROWN = 0.35, (1.35, 0.95, 0.7)  # what a dark iris has at most, and brown beside the mean of its channels
_BESIDE, _BETWEEN, _LIT = 1.15, (0.25, 0.85), 0.8  # radii; of the way between the lids; which quantile is well lit
_ALONG, _ACROSS = 24, 6  # places of an eye that are looked at
_DARKEST_WHITE = 0.6  # beside the material's


def iris_color(
    posed: Mesh | Sequence[Mesh], images: Sequence[Tensor], cameras: Sequence[Camera], irises: Tensor | None = None
) -> Tensor | None:
    """The irises' colour (3,), sRGB, or None where no photograph is large enough to show it.

    Rings about their centres count, without lids, lashes and highlights: each channel's median of photographs that are
    large enough, so that one in coloured light does not decide. Dark irises in purple light are brown.

    Args:
        posed: the head as the photographs show it, or as each of them does, with the 68 landmarks.
        irises: centres in each photograph, (I,2,2) pixels; where it is darkest between the lids if absent.
    """
    found, radii = list[Tensor](), list[float]()
    for image, eyes, centres, radius in _eyes(posed, images, cameras, irises):
        if centres is None:
            rings = [_darkest_ring(image, lids, radius) for lids in eyes]
        else:
            rings = [
                _ring(image, centre, lids, radius)
                for centre, lids in zip(centres, eyes, strict=True)
                if bool(torch.isfinite(centre).all())
            ]
        colors = torch.cat(rings) if rings else torch.zeros(0, 3)
        if len(colors) < _MIN_RING:
            continue
        light = colors.mean(1)
        kept = (light >= light.quantile(0.35)) & (light <= light.quantile(0.75))
        color = colors[kept].median(0).values.float()
        purple = float(color[1]) < _PURPLE * float(color[[0, 2]].min())  # no iris is, but flashed pupils and red lids
        if purple and float(color.max()) < _DIM:
            color, purple = color.mean() * color.new_tensor(_BROWN), False
        if float(color.max()) > _DARKEST and not purple:  # else nothing but pupil and shadow is seen
            found.append(color.clamp(0.03, 0.9))
            radii.append(radius)
    large = [color for color, radius in zip(found, radii, strict=True) if radius >= _LARGE * max(radii)]
    return torch.stack(large).quantile(0.5, dim=0) if large else None


def white_brightness(
    posed: Mesh | Sequence[Mesh], images: Sequence[Tensor], cameras: Sequence[Camera], irises: Tensor | None = None
) -> float:
    """How bright the whites of eyes are beside their material's, in [0.6,1]; 1 where no photograph shows them.

    Lids shade them, and the material's own would be too bright. Arguments as of :func:`iris_color`.
    """
    found = list[Tensor]()
    for image, eyes, centres, radius in _eyes(posed, images, cameras, irises):
        for number, lids in enumerate(eyes):
            centre = lids.mean(0) if centres is None else centres[number]
            if not bool(torch.isfinite(centre).all()):
                continue
            at = _between(lids)
            x, y = at.round().long().T
            seen = ((at - centre).norm(dim=1) > _BESIDE * radius) & (x >= 0) & (y >= 0)
            seen &= (x < image.shape[2]) & (y < image.shape[1])
            if int(seen.sum()) >= _MIN_RING:
                found.append(image[:3, y[seen], x[seen]].mean(0).quantile(_LIT))
    if not found:
        return 1.0
    usual = sum(EYEBALL.color) / len(EYEBALL.color)
    return min(max(float(torch.stack(found).quantile(0.5)) / usual, _DARKEST_WHITE), 1.0)


def _eyes(
    posed: Mesh | Sequence[Mesh], images: Sequence[Tensor], cameras: Sequence[Camera], irises: Tensor | None
) -> Iterator[tuple[Tensor, Tensor, Tensor | None, float]]:
    """Each photograph (3,H,W) that is large enough, its lids' landmarks (2,6,2), the irises' centres (2,2) where they
    are known, and their radius, pixels."""
    meshes = [posed] * len(images) if isinstance(posed, Mesh) else posed
    for number, (mesh, image, camera) in enumerate(zip(meshes, images, cameras, strict=True)):
        marks = mesh.vertices[mesh.landmarks][36:48].detach().cpu().double()
        depth = float((marks @ camera.rotation.double()[2] + camera.translation.double()[2]).mean())
        radius = 0.5 * IRIS_WIDTH * float(camera.intrinsics[0, 0]) / depth
        if radius >= _MIN_RADIUS:
            centres = None if irises is None else irises[number].double()
            yield image.cpu(), camera.project(marks).view(2, 6, 2), centres, radius


def _between(lids: Tensor) -> Tensor:
    """Places (P,2) between lids of six landmarks (6,2), from corner to corner."""
    along = torch.linspace(0, 1, _ALONG + 2, dtype=lids.dtype)[1:-1, None] * 3
    piece = along.long().clamp(max=2)
    upper, lower = (
        torch.lerp(line[piece[:, 0]], line[piece[:, 0] + 1], along - piece) for line in (lids[:4], lids[[0, 5, 4, 3]])
    )
    across = torch.linspace(*_BETWEEN, _ACROSS, dtype=lids.dtype)[:, None, None]
    return torch.lerp(upper, lower, across).flatten(0, 1)


def _darkest_ring(image: Tensor, lids: Tensor, radius: float) -> Tensor:
    """The ring (Q,3) that is darkest of those about places between lids (6,2), as people do not look ahead at times."""
    way = radius * torch.nn.functional.normalize(lids[3] - lids[0], dim=0)
    rings = [_ring(image, lids.mean(0) + shift * way, lids, radius) for shift in _SHIFTS]
    return min(rings, key=lambda ring: float(ring.mean()) if 2 * len(ring) >= _MIN_RING else math.inf)


def _ring(image: Tensor, centre: Tensor, lids: Tensor, radius: float) -> Tensor:
    """The colours (Q,3) of an image (3,H,W) round an iris' centre (2,), between lids of six landmarks (6,2)."""
    side = torch.arange(-math.ceil(radius), math.ceil(radius) + 1, dtype=torch.float64)
    dy, dx = torch.meshgrid(side, side, indexing="ij")
    y, x = (centre[1] + dy).round().long(), (centre[0] + dx).round().long()
    from_middle = ((x - centre[0]).square() + (y - centre[1]).square()).sqrt() / radius
    # The upper lid's shadow and lashes lie within a fifth of the iris' width.
    top = max(float(lids[[1, 2], 1].mean() - centre[1]) + 0.35 * radius, -0.6 * radius)
    bottom = float(lids[[4, 5], 1].mean() - centre[1]) - 0.1 * radius
    ring = (from_middle > _RING[0]) & (from_middle < _RING[1]) & (dy > top) & (dy < bottom)
    ring &= (x >= 0) & (y >= 0) & (x < image.shape[2]) & (y < image.shape[1])
    return image[:3, y[ring], x[ring]].T.double()


def with_iris(mesh: Mesh, iris: Tensor) -> Mesh:
    """A mesh at rest whose texture has painted eyeballs, with their irises in another colour (3,), fibres and all."""
    if mesh.texture is None or mesh.uvs is None or mesh.uv_faces is None:
        return mesh
    height, width = mesh.texture.shape[1:]
    texture, vertices = mesh.texture.cpu().flatten(1).clone(), mesh.vertices.detach().cpu().double()
    for name, mask in mesh.regions.items():
        if part_material(name) is not EYEBALL or not bool(mask.any()):
            continue
        inside = mask.cpu()[mesh.faces.cpu()].all(1)
        texels = rasterise_uvs(mesh.uvs, mesh.uv_faces[inside], height, width)
        ball = vertices[mask.cpu()]
        at = texels.interpolate(vertices - (ball.amin(0) + ball.amax(0)) / 2, mesh.faces.cpu()[inside])
        from_axis = at[:, :2].norm(dim=1) / (0.5 * IRIS_WIDTH)
        front = (from_axis < 1.05) & (at[:, 2] > 0)
        rows, from_axis = texels.texels[front], from_axis[front]
        ring = texture[:, rows[(from_axis > _RING[0]) & (from_axis < _RING[1])]]
        if ring.numel():
            colors = texture[:, rows]
            colored = colors * (iris.to(colors) / ring.median(1).values.clamp(min=0.02))[:, None]
            dark = ((_WHITE - colors.mean(0)) / 0.1).clamp(0, 1)  # what is left of the white beside it stays
            texture[:, rows] = torch.lerp(colors, colored.clamp(0, 1), dark)
    return replace(mesh, texture=texture.view_as(mesh.texture).to(mesh.texture))
