"""Texture and colours of a fitted head from the photographs that it was fitted to: its skin and its irises."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.io.gltf.region_materials import EYEBALL, IRIS, part_material
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.mesh import Mesh
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.modeling.photographs.fit_settings import FitSettings
from torchface.modeling.photographs.hair_cap import HairCap, hair_beyond, hair_cap
from torchface.modeling.photographs.landmark_view import LANDMARKS
from torchface.modeling.photographs.skin_light import skin_light, unlit
from torchface.modeling.photographs.skin_mask import FacePlaces, ShownParts
from torchface.modeling.photographs.texture_fit import ColorFit, fit_colors
from torchface.modeling.photographs.texture_projection import PhotoTexture, photo_texture
from torchface.rendering.camera_visibility import PosedSurface, Shown, shown_in
from torchface.rendering.clay_shading import sample_texture
from torchface.rendering.environment_light import EnvironmentLight
from torchface.rendering.raycast import RayCaster

GREY = 0.015
"""Mean difference of the channels below which a photograph has no colours."""

_BARE = 0.7  # share of skin from which a vertex counts for the light
_SQUARE, _UNLIKE, _AROUND, _WITHIN = (
    0.2,
    0.16,
    0.14,
    0.85,
)  # cosine, of full white, of the eyes' distance, share of skin
_BROWS, _REPAINTED = 0.5, 12  # share of a brow that photographs show, rings of vertices
_MIN_DIAMETER = 14.0  # across an eyeball; of smaller ones a photograph shows no iris
_SHARE = (0.15, 0.40)
"""Of the eyeball between the lids, the darkest first: lashes and pupil, then the iris, then white and highlights."""

_MIN_PIXELS = 40
_IRIS_WIDTH, _MIN_RADIUS, _MIN_RING, _RING = 11.7, 2.5, 6, (0.45, 0.8)  # millimetres, pixels, pixels, radii
_DARKEST, _LARGE = 0.07, 0.4  # of the largest iris' radius: in which photographs colours count
_WHITE = 0.72  # mean of the channels from which an eyeball's texel is no iris
_PUPIL = 0.38  # of the iris
_LID_SHADOW = 0.5  # of the eye's opening
_IRIS_COSINE = 0.9  # of the angle between the eye's axis and the border of an iris 11 mm wide


@dataclass(frozen=True, eq=False)
class Skin:
    """Colours of the vertices (V,3), a texture (3,size,size) where there is a layout, the colour model's answer, the
    hair's colour (3,) where it is seen, and the irises' (3,) where they are seen."""

    colors: Tensor | None
    texture: Tensor | None
    fit: ColorFit | None
    hair: Tensor | None = None
    iris: Tensor | None = None

    def on(self, mesh: Mesh) -> Mesh:
        """A mesh with it; one without a layout or a colour model keeps its own."""
        colors = mesh.colors if self.colors is None else self.colors
        return replace(mesh, colors=colors, texture=mesh.texture if self.texture is None else self.texture)


def photographed_skin(
    posed: Sequence[Mesh],
    color: MorphableModel | None,
    images: Sequence[Tensor],
    cameras: Sequence[Camera],
    settings: FitSettings,
    rest: Mesh | None = None,
) -> Skin:
    """A head's skin from photographs and a colour model.

    Args:
        posed: the head as each photograph shows it; its own skin is the template's.
        color: model of vertex colours, if there is one.
        images: photographs, (3,H,W) each.
        cameras: one each.
        settings: the texture's size, parts and irises of the photographs, and whether hair is painted on the head.
        rest: the head whose eyes look ahead, along z; the first of those posed if absent.

    Returns:
        With texture coordinates: the photographs projected onto the head, their light divided out; where none shows it
        the colour model, else the template's skin; hair as a cap. Without: the colour model's colours.
    """
    size, parts, irises, paint_hair = (
        settings.texture_size, settings.parts, settings.irises, settings.paint_hair
    )  # fmt: skip
    fit = None if color is None else fit_colors(color, posed, images, cameras)
    mesh = posed[0]
    base = _own_colors(mesh) if fit is None else fit.colors
    if base is not None and all(float((one.amax(0) - one.amin(0)).mean()) < GREY for one in images):
        base = base.mean(1, keepdim=True).expand_as(base)  # else a grey face has a coloured neck
    if mesh.uvs is None or size == 0:
        return Skin(base, None, fit)
    others, count = part_vertices(mesh), len(images)
    confidence: Tensor | None = None
    lights: list[EnvironmentLight | None] | None = None
    cap: HairCap | None = None
    if _has_landmarks(mesh):
        surfaces, places = PosedSurface.each(posed, count), [FacePlaces.of(one) for one in posed]
        shown = [
            surface.shown_in(image, camera) for surface, image, camera in zip(surfaces, images, cameras, strict=True)
        ]
        graph = VertexGraph(mesh.faces.cpu(), len(mesh.vertices))
        seen: Sequence[FaceParts | None] = parts or [None] * count
        known = [
            ShownParts.of(one, camera.project(surface.vertices), where, graph)
            for one, camera, surface, where in zip(seen, cameras, surfaces, places, strict=True)
        ]
        lights = [
            skin_light(at, surface.normals, camera, where.cheeks & ~others & (one.bare > _BARE))
            for at, surface, camera, where, one in zip(shown, surfaces, cameras, places, known, strict=True)
        ]
        shown = [
            replace(at, colors=unlit(at.colors, surface.normals, camera, light))
            for at, surface, camera, light in zip(shown, surfaces, cameras, lights, strict=True)
        ]
        if parts is not None:
            confidence = torch.stack(
                [
                    one.own * _like_skin(at, one, where, graph)
                    for at, one, where in zip(shown, known, places, strict=True)
                ]
            )
            if base is not None and float(confidence[:, places[0].brow].amax(0).mean()) > _BROWS:
                base = _without_brows(base, places[0], graph)
            cap = hair_cap(shown, places, torch.where(others, 0.0, torch.stack([one.hair for one in known])))
            if cap is None:
                marks = [
                    camera.project(surface.vertices[mesh.landmarks.cpu()])
                    for surface, camera in zip(surfaces, cameras, strict=True)
                ]
                cap = hair_beyond(images, parts, marks, places[0])
    own = base is None and bool(others.any()) and not bool(others.all())
    if own:
        confidence = torch.where(others, 0.0, torch.ones(count, len(others)) if confidence is None else confidence)
    texture = photo_texture(posed, images, cameras, size, base, confidence, lights)
    if cap is not None and paint_hair:
        texture = _capped(texture, cap, mesh, others)
    colors = texture.colors
    iris = iris_color(posed, images, cameras, irises)
    if own or iris is not None:
        rest, painted = rest or mesh, torch.tensor(IRIS.color) if iris is None else iris
        colored = with_part_colors(replace(rest, colors=colors), painted)
        colors = colors if colored.colors is None else colored.colors
        texture = _with_parts(texture, colors, rest, others, painted) if own else texture
    return Skin(colors, texture.image, fit, None if cap is None else cap.color, iris)


def _without_brows(colors: Tensor, places: FacePlaces, graph: VertexGraph) -> Tensor:
    """Vertex colours (V,3) with skin for brows: beside those of photographs a template's would be a second pair."""
    beside = graph.smoothed(colors.double(), (~places.brow).double(), _REPAINTED)
    return torch.where(places.brow[:, None], beside, colors.double()).to(colors)


def _like_skin(shown: Shown, parts: ShownParts, places: FacePlaces, graph: VertexGraph) -> Tensor:
    """0 where what is taken for skin ends in other colours than skin, as beside hair and in its shadow, (V,)."""
    bare = parts.bare * (shown.cosine > _SQUARE) * ~places.features
    if float(bare.max()) < _BARE:
        return torch.ones_like(bare)
    skin = shown.colors[bare > _BARE].double().median(0).values
    unlike = (skin - shown.colors.double()).clamp(min=0).norm(dim=1) / _UNLIKE  # highlights are skin
    edge = (places.place[graph.first] - places.place[graph.second]).norm(dim=1).median()
    rings = round(4 * float(_AROUND / edge) ** 2)
    around = graph.smoothed((parts.own * (shown.cosine > _SQUARE))[:, None], torch.ones_like(bare), rings)[:, 0]
    return (places.features | (around > _WITHIN) | (unlike < 1) | (parts.own - parts.bare > 0.3)).double()


def _capped(texture: PhotoTexture, cap: HairCap, mesh: Mesh, parts: Tensor) -> PhotoTexture:
    """A texture with the hair painted over it, but not over parts (V,) that are no skin."""
    place = cap.places.place
    at = texture.texels.interpolate(torch.cat([place, (~parts).double()[:, None]], dim=1), mesh.faces.cpu())
    image = texture.image.flatten(1)[:, texture.texels.texels].T.double()
    painted = cap.painted(image, at[:, :3], at[:, 3] * cap.share(at[:, :3]))
    colors = cap.painted(texture.colors.double(), place, ~parts * cap.share(place))
    return replace(texture, image=texture.texels.image(painted), colors=colors.float())


def _with_parts(texture: PhotoTexture, colors: Tensor, mesh: Mesh, parts: Tensor, iris: Tensor) -> PhotoTexture:
    """A texture that shows parts (V,) that are no skin in their colours (V,3), and eyeballs with an iris and a pupil.

    Args:
        mesh: at rest.
        iris: its colour, sRGB (3,).
    """
    texels, faces = texture.texels, mesh.faces.cpu()
    corners = faces[texels.triangles]
    painted = texels.interpolate(colors.double(), faces)
    for name, mask in ({} if mesh.annotations is None else mesh.annotations.regions).items():
        if part_material(name) is EYEBALL and bool(mask.any()):
            ball = mesh.vertices[mask].detach().cpu().double()
            at = texels.interpolate(mesh.vertices.detach().cpu().double() - (ball.amin(0) + ball.amax(0)) / 2, faces)
            aside = torch.where(at[:, 2] > 0, at[:, :2].norm(dim=1) / (0.5 * _IRIS_WIDTH), torch.inf)[:, None]
            ringed = iris.double() * (1.1 - 0.5 * (aside.clamp(max=1) - 0.75).clamp(min=0) / 0.25)  # a dark rim
            eye = torch.where(aside < _PUPIL, 0.04, torch.where(aside < 1, ringed, painted.new_tensor(EYEBALL.color)))
            if _has_landmarks(mesh):
                eye = eye * _under_lids(mesh, ball, at)[:, None]
            painted = torch.where(mask.cpu()[corners].all(1)[:, None], eye, painted)
    shown = texture.image.flatten(1)[:, texels.texels].T.double()
    part = parts[corners].all(1)[:, None]
    return replace(texture, image=texels.image(torch.where(part, painted, shown).clamp(0, 1)))


def _under_lids(mesh: Mesh, ball: Tensor, at: Tensor) -> Tensor:
    """How much light lids at rest let through to texels (P,3) about the middle of an eyeball (W,3), (P,) in [0,1]."""
    middle = (ball.amin(0) + ball.amax(0)) / 2
    lids = mesh.vertices[mesh.landmarks[36:48]].detach().cpu().double().view(2, 6, 3) - middle
    eye = lids[int(lids.mean(1).norm(dim=1).argmin())]
    high, low = eye[[1, 2], 1].mean(), eye[[4, 5], 1].mean()
    reach = _LID_SHADOW * (high - low).clamp(min=1e-6)
    return (1 - 0.5 * (1 - (high - at[:, 1]) / reach).clamp(0, 1)) * (
        1 - 0.2 * (1 - (at[:, 1] - low) / reach).clamp(0, 1)
    )


def _has_landmarks(mesh: Mesh) -> bool:
    annotations = mesh.annotations
    return annotations is not None and annotations.landmarks is not None and len(annotations.landmarks) == LANDMARKS


def _own_colors(mesh: Mesh) -> Tensor | None:
    """Vertex colours (V,3) of a mesh: its own, else those of its texture."""
    if mesh.colors is not None:
        return mesh.colors.cpu().float()
    if mesh.texture is None or mesh.uvs is None or mesh.uv_faces is None:
        return None
    row = torch.zeros(len(mesh.vertices), dtype=torch.int64)
    row[mesh.faces.cpu().flatten()] = mesh.uv_faces.cpu().flatten()
    return sample_texture(mesh.texture.cpu(), mesh.uvs.cpu()[row])


def part_vertices(mesh: Mesh) -> Tensor:
    """The vertices of parts that are no skin, by the names of their regions, (V,) bool."""
    result = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    for name, mask in ({} if mesh.annotations is None else mesh.annotations.regions).items():
        if part_material(name) is not None:
            result |= mask.cpu()
    return result


def iris_color(
    posed: Mesh | Sequence[Mesh], images: Sequence[Tensor], cameras: Sequence[Camera], irises: Tensor | None = None
) -> Tensor | None:
    """The irises' colour (3,), sRGB, or None where no photograph is large enough to show it.

    Where the irises are known, rings about their centres count, without lids, lashes and highlights. Else what is seen
    of the eyeballs between the lids: the dark share that is neither lash and pupil nor white.

    Args:
        posed: the head as the photographs show it, or as each of them does, its eyeballs annotated.
        images: photographs, (3,H,W) each.
        cameras: one each.
        irises: centres in each photograph, (I,2,2) pixels.
    """
    ringed = None if irises is None else _ring_color(irises, images, cameras, posed)
    if ringed is not None:
        return ringed
    meshes = [posed] * len(images) if isinstance(posed, Mesh) else posed
    regions = {} if meshes[0].annotations is None else meshes[0].annotations.regions
    balls = [mask.cpu() for name, mask in regions.items() if part_material(name) is EYEBALL and bool(mask.any())]
    if not balls:
        return None
    clear = torch.zeros(len(meshes[0].vertices), dtype=torch.bool)
    for name, mask in regions.items():
        material = part_material(name)
        clear |= mask.cpu() if material is not None and material.alpha == "BLEND" else torch.zeros_like(clear)
    seen = []
    for mesh, image, camera in zip(meshes, images, cameras, strict=True):  # photographs
        vertices, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
        caster = RayCaster(vertices, faces[~clear[faces].all(1)])
        shown = shown_in(image.cpu(), camera, caster, vertices, vertex_normals(vertices, faces))
        for ball in balls:
            pixels = camera.project(vertices[ball])
            if float((pixels.amax(0) - pixels.amin(0)).amin()) >= _MIN_DIAMETER:
                seen.append(shown.colors[ball & (shown.cosine > 0.3)].double())
    colors = torch.cat(seen) if seen else torch.zeros(0, 3, dtype=torch.float64)
    if len(colors) < _MIN_PIXELS:
        return None
    order = colors.mean(1).argsort()
    first, last = (round(share * len(order)) for share in _SHARE)
    return colors[order[first : max(last, first + 1)]].median(0).values.clamp(0.03, 0.9).float()


def _ring_color(
    irises: Tensor, images: Sequence[Tensor], cameras: Sequence[Camera], posed: Mesh | Sequence[Mesh]
) -> Tensor | None:
    """The colour (3,) of rings about the irises' centres (I,2,2), each channel's median of photographs that are large
    enough, so that one in coloured light does not decide; None without any."""
    found, radii = list[Tensor](), list[float]()
    meshes = [posed] * len(images) if isinstance(posed, Mesh) else posed
    for mesh, image, camera, centres in zip(meshes, images, cameras, irises.double(), strict=True):
        marks = mesh.vertices[mesh.landmarks][36:48].detach().cpu().double()
        depth = float((marks @ camera.rotation.double()[2] + camera.translation.double()[2]).mean())
        radius = 0.5 * _IRIS_WIDTH * float(camera.intrinsics[0, 0]) / depth
        if radius < _MIN_RADIUS:
            continue
        seen = camera.project(marks)
        eyes = zip(centres, (seen[:6], seen[6:]), strict=True)
        rings = [_ring(image, centre, lids, radius) for centre, lids in eyes if bool(torch.isfinite(centre).all())]
        colors = torch.cat(rings) if rings else torch.zeros(0, 3)
        if len(colors) < _MIN_RING:
            continue
        light = colors.mean(1)
        kept = (light >= light.quantile(0.35)) & (light <= light.quantile(0.75))
        color = colors[kept].median(0).values.float()
        if float(color.max()) > _DARKEST:  # else nothing but pupil and shadow is seen
            found.append(color.clamp(0.03, 0.9))
            radii.append(radius)
    large = [color for color, radius in zip(found, radii, strict=True) if radius >= _LARGE * max(radii)]
    return torch.stack(large).quantile(0.5, dim=0) if large else None


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
    if mesh.texture is None or mesh.uvs is None or mesh.uv_faces is None or mesh.annotations is None:
        return mesh
    height, width = mesh.texture.shape[1:]
    texture, vertices = mesh.texture.cpu().flatten(1).clone(), mesh.vertices.detach().cpu().double()
    for name, mask in mesh.annotations.regions.items():
        if part_material(name) is not EYEBALL or not bool(mask.any()):
            continue
        inside = mask.cpu()[mesh.faces.cpu()].all(1)
        texels = rasterise_uvs(mesh.uvs, mesh.uv_faces[inside], height, width)
        ball = vertices[mask.cpu()]
        at = texels.interpolate(vertices - (ball.amin(0) + ball.amax(0)) / 2, mesh.faces.cpu()[inside])
        from_axis = at[:, :2].norm(dim=1) / (0.5 * _IRIS_WIDTH)
        front = (from_axis < 1.05) & (at[:, 2] > 0)
        rows, from_axis = texels.texels[front], from_axis[front]
        ring = texture[:, rows[(from_axis > _RING[0]) & (from_axis < _RING[1])]]
        if ring.numel():
            colors = texture[:, rows]
            colored = colors * (iris.to(colors) / ring.median(1).values.clamp(min=0.02))[:, None]
            dark = ((_WHITE - colors.mean(0)) / 0.1).clamp(0, 1)  # what is left of the white beside it stays
            texture[:, rows] = torch.lerp(colors, colored.clamp(0, 1), dark)
    return replace(mesh, texture=texture.view_as(mesh.texture).to(mesh.texture))


def with_part_colors(mesh: Mesh, iris: Tensor | None) -> Mesh:
    """A mesh with vertex colours whose parts have those of their materials, and whose eyeballs have the iris in front.

    Args:
        mesh: a head with colours.
        iris: sRGB (3,); the eyeballs' own if absent.
    """
    if mesh.colors is None or mesh.annotations is None:
        return mesh
    colors = mesh.colors.clone()
    for name, mask in mesh.annotations.regions.items():
        material = part_material(name)
        if material is None or not bool(mask.any()):
            continue
        colors[mask] = colors.new_tensor(material.color)
        if material is EYEBALL and iris is not None:
            ball = mesh.vertices[mask]
            ahead = torch.nn.functional.normalize(ball - (ball.amin(0) + ball.amax(0)) / 2, dim=1)[:, 2]
            colors[mask.nonzero()[:, 0][ahead > _IRIS_COSINE]] = iris.to(colors)
    return replace(mesh, colors=colors)
