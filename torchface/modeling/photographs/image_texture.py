"""Texture and colours of a fitted head from the photographs that it was fitted to: its skin and its irises."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.mesh import Mesh
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.modeling.photographs.eye_color import IRIS_WIDTH, iris_color, white_brightness
from torchface.modeling.photographs.fit_settings import FitSettings
from torchface.modeling.photographs.hair_cap import HairCap, hair_cap
from torchface.modeling.photographs.landmark_view import LANDMARKS
from torchface.modeling.photographs.skin_light import (
    exposed,
    light_hue,
    like_skin_around,
    patch_offset,
    skin_light,
    unlit,
)
from torchface.modeling.photographs.skin_mask import FacePlaces, ShownParts, ramp
from torchface.modeling.photographs.texture_fit import ColorFit, fit_colors
from torchface.modeling.photographs.texture_projection import PhotoTexture, photo_texture
from torchface.part_materials import EYEBALL, IRIS, part_material
from torchface.registration.scan_colors import own_colors
from torchface.rendering.camera_visibility import PosedSurface, Shown
from torchface.rendering.environment_light import EnvironmentLight

GREY = 0.015
"""Mean difference of the channels below which a photograph has no colours."""

_STRANDS = 0.5  # how near hair is from which what is dark beside a brow may be its ends
_BARE = 0.7  # share of skin from which a vertex counts for the light
_SQUARE, _UNLIKE, _AROUND, _WITHIN = 0.2, 0.16, 30, 0.85  # cosine, of full white, rounds, share of skin
_BROWS = 0.5  # share of a brow that photographs show
# In distances of the eyes' outer corners: behind the ears' landmarks, and before them so far over the eyes, hair may
# grow. Logarithms of colours by which shades of skin differ.
_SCALP, _AS_DARK = (0.35, -0.3, -0.5), 0.12
_FEWEST, _FILTERED = 3, 0.3  # photographs of which one is odd, by logarithms of its channels
_PUPIL, _SOFT = 0.38, 0.1  # of the iris: the pupil, and how wide edges are: texels are coarse
_LID_SHADOW = 0.5  # of the eye's opening
_TONE, _SEAM = 40, 16  # rounds over the mesh: the skin around, and the band in which what is completed begins
_EVEN = 0.04, 0.10  # of a skin's brightness: what is added to it against shadows in even light at most, in shadows
_DARK = 0.02  # of full white
_SKIN = (0.80, 0.55, 0.48)  # whose hue the light of photographs is judged by where there is no colour model
# Logarithms by which a place of skin differs from the skin around it, in brightness and hue: strands of hair, and folds
# in shadow differ more.
_FOLDS, _PORES, _FRAMED_SKIN = (0.8, 0.12), (0.2, 0.06), (0.06, 0.04)
_GLASS, _GLASSES, _FRAMED = 0.3, 0.03, 0.5  # shares: of a place, of the places where frames lie, of those that count
# Of the eyes' outer corners' distance; share of glasses at a place of the bridge, and of its places: with rimless
# glasses 0.075, of 8 people without at most 0.02.
_BRIDGE, _ON_BRIDGE, _OF_BRIDGE = 0.1, 0.1, 0.05
_BROW_ENDS = 0.6, 0.95  # shares of skin between which hair of brows and beards ends
# Lips and cheeks keep light from teeth, tongue and throat: shares at the front and far back, and millimetres behind the
# foremost.
_IN_MOUTH = "teeth", "gums_and_tongue", "mouth"
_MOUTH_LIGHT, _MOUTH_BACK = (0.85, 0.3), (4.0, 28.0)
_IRIS_COSINE = 0.9  # of the angle between the eye's axis and the border of an iris 11 mm wide


@dataclass(frozen=True, eq=False)
class Skin:
    """Colours of the vertices (V,3), a texture (3,size,size) where there is a layout, the colour model's answer, the
    hair's colour (3,) where it is seen, the irises' (3,) where they are seen, and whether there is a fringe."""

    colors: Tensor | None
    texture: Tensor | None
    fit: ColorFit | None
    hair: Tensor | None = None
    iris: Tensor | None = None
    fringe: bool = False

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
    size, parts, irises = settings.texture_size, settings.parts, settings.irises
    if parts is not None:
        images = [exposed(image, shown) for image, shown in zip(images, parts, strict=True)]
    fit = None if color is None else fit_colors(color, posed, images, cameras)
    mesh = posed[0]
    base = own_colors(mesh) if fit is None else fit.colors
    if base is not None and without_colors(images):
        base = base.mean(1, keepdim=True).expand_as(base)  # else a grey face has a coloured neck
    if mesh.uvs is None or size == 0:
        return Skin(base, None, fit)
    others, count = part_vertices(mesh), len(images)
    confidence: Tensor | None = None
    lights: list[EnvironmentLight | None] | None = None
    patches: list[Tensor] | None = None
    cap: HairCap | None = None
    if _has_landmarks(mesh):
        graph = VertexGraph(mesh.faces.cpu(), len(mesh.vertices), mesh.vertices.detach().cpu())
        seen: Sequence[FaceParts | None] = parts or [None] * count
        views = [
            _lit_evenly(image, camera, surface, FacePlaces.of(one), known, graph, others)
            for image, camera, surface, one, known in zip(
                images, cameras, PosedSurface.each(posed, count), posed, seen, strict=True
            )
        ]
        lights = [view.light for view in views]
        if parts is not None:
            mirror = None if mesh.annotations is None else mesh.annotations.mirror
            odd = _filtered(views)
            grey = without_colors(images)
            usual = mesh.vertices.new_tensor(_SKIN).cpu().expand(len(others), 3) if base is None and not grey else base
            views = [_without_patches(view, usual, graph, others, mirror) for view in views]
            images, patches = [view.image for view in views], [view.patch for view in views]
            places = [view.places for view in views]
            confidence = torch.stack([view.parts.own * _like_skin(view, graph) for view in views])
            plain = torch.stack([(view.shown.cosine > _SQUARE) for view in views]) * confidence * ~odd[:, None]
            confidence = torch.where(odd[:, None], confidence * (1 - plain.amax(0)), confidence)
            if base is not None:
                base = _bare(base, places[0], graph, float(confidence[:, places[0].brow].amax(0).mean()) > _BROWS)
            hair = torch.where(others, 0.0, torch.stack([view.parts.hair for view in views]))
            pixels = [view.camera.project(view.surface.vertices) for view in views]
            marks = [one[mesh.landmarks.cpu()] for one in pixels]
            cap = hair_cap(images, parts, marks, [view.shown for view in views], places, hair)
    own = base is None and bool(others.any()) and not bool(others.all())
    if own:
        confidence = torch.where(others, 0.0, torch.ones(count, len(others)) if confidence is None else confidence)
    texture = photo_texture(posed, images, cameras, size, base, confidence, lights, patches)
    if parts is not None and patches is not None:
        glasses = [one.at(at, "glasses") for one, at in zip(parts, pixels, strict=True)]
        texture = _without_sharp_shadows(texture, views, mesh, graph, others, _spectacles(views, glasses))
    if cap is not None and settings.paint_hair:
        texture = _capped(texture, cap, mesh, others)
    colors = texture.colors
    iris = iris_color(posed, images, cameras, irises) if _has_landmarks(mesh) else None
    if own or iris is not None:
        rest, painted = rest or mesh, torch.tensor(IRIS.color) if iris is None else iris
        colored = with_part_colors(replace(rest, colors=colors), painted)
        colors = colors if colored.colors is None else colored.colors
        if own:
            white = white_brightness(posed, images, cameras, irises) * torch.tensor(EYEBALL.color)
            texture = _with_parts(texture, colors, rest, others, torch.stack([painted, white]))
    of_hair, fringe = (None, False) if cap is None else (cap.color, cap.fringe)
    return Skin(colors, texture.image, fit, of_hair, iris, fringe)


def without_colors(images: Sequence[Tensor]) -> bool:
    """Whether all photographs, (3,H,W) each, are black and white."""
    return all(float((one[:3].amax(0) - one[:3].amin(0)).mean()) < GREY for one in images)


@dataclass(frozen=True, eq=False)
class _View:
    """A photograph and what it shows of the head's vertices in even light."""

    image: Tensor  # (3,H,W)
    camera: Camera
    surface: PosedSurface
    places: FacePlaces
    parts: ShownParts
    shown: Shown
    light: EnvironmentLight | None  # that was divided out
    patch: Tensor  # that was added to the colours then, (V,3)


def _lit_evenly(
    image: Tensor,
    camera: Camera,
    surface: PosedSurface,
    places: FacePlaces,
    parts: FaceParts | None,
    graph: VertexGraph,
    others: Tensor,
) -> _View:
    shown = surface.shown_in(image, camera)
    known = ShownParts.of(parts, camera.project(surface.vertices), places, graph)
    light = skin_light(shown, surface.normals, camera, places.cheeks & ~others & (known.bare > _BARE))
    shown = replace(shown, colors=unlit(shown.colors, surface.normals, camera, light))
    return _View(image, camera, surface, places, known, shown, light, torch.zeros_like(surface.vertices))


def _without_patches(
    view: _View, base: Tensor | None, graph: VertexGraph, others: Tensor, mirror: Tensor | None
) -> _View:
    """A view without the hue of its light, and with what is to be added to its colours against shadows."""
    shown = view.shown
    skin = view.parts.bare * shown.cosine.clamp(min=0) * ~(view.places.features | others)
    hue = light_hue(shown.colors, skin, base)
    image = (view.image / hue[:, None, None]).clamp(0, 1).to(view.image)
    shown = replace(shown, colors=(shown.colors / hue).clamp(0, 1).to(shown.colors))
    return replace(
        view, image=image, shown=shown, patch=patch_offset(shown.colors, skin, base, graph, mirror, view.parts.doubt)
    )


def _spectacles(views: Sequence[_View], glasses: Sequence[Tensor]) -> Tensor:
    """How far each vertex lies where spectacles have frames, whose thin parts look like skin to the network, (V,),
    by how surely each photograph shows glasses there, (V,)."""
    frames, framed, on_bridge = [view.places.frames for view in views], [], []
    for view, share in zip(views, glasses, strict=True):
        shown, share = view.shown.cosine > 0, share.nan_to_num(0.0)
        # In small faces, and of glasses without rims, thin frames show on the bridge of the nose alone.
        bridge = (view.places.place[:, :2].abs() < _BRIDGE).all(1) & shown
        framed.append((share[(view.places.frames > _FRAMED) & shown] > _GLASS).float().mean())
        on_bridge.append((share[bridge] > _ON_BRIDGE).float().mean())
    # Blurred sockets of eyes are glasses to the network in some pictures of a film.
    worn = any(
        float(torch.stack(shares).nan_to_num(0.0).median()) > least
        for shares, least in ((framed, _GLASSES), (on_bridge, _OF_BRIDGE))
    )
    return frames[0] * worn


def _without_sharp_shadows(
    texture: PhotoTexture, views: Sequence[_View], mesh: Mesh, graph: VertexGraph, others: Tensor, frames: Tensor
) -> PhotoTexture:
    """A texture whose skin is like the skin around it where much was to be done against shadows, on upper lids and
    where spectacles have frames.

    In even light it stays as it is, with its moles, but for what is far darker or redder than the skin around it.

    Args:
        others: parts that are no skin, (V,) bool.
        frames: see ``_spectacles``.
    """
    places, faces = views[0].places, mesh.faces.cpu()
    bare = torch.stack([view.parts.bare * (view.shown.cosine > 0) for view in views]).amax(0)
    bare = ((bare - _BROW_ENDS[0]) / (_BROW_ENDS[1] - _BROW_ENDS[0])).clamp(0, 1)
    bare = torch.lerp((~places.brow).double(), bare, texture.seen.double()) * ~others
    colors = texture.colors.double()
    tone = graph.smoothed(colors, bare * ~places.features, _TONE)
    added = torch.stack([view.patch for view in views]).abs().mean(-1).amax(0) / tone.mean(1).clamp(min=_DARK)
    doubt = torch.stack([view.parts.doubt for view in views]).amax(0)
    shaded = ((graph.smoothed(added[:, None], bare, _TONE)[:, 0] - _EVEN[0]) / (_EVEN[1] - _EVEN[0])).clamp(0, 1)
    image = texture.image.flatten(1)[:, texture.texels.texels].T.double()
    flat = torch.maximum(bare * places.rim * torch.maximum(shaded, doubt), places.lids * ~(places.brow | others))
    flat = torch.maximum(flat, doubt * ~(places.features | others))  # strands
    # What no photograph shows has another tone: seen skin comes near it toward its edge, over a broad band.
    apart, seen = places.features | others, texture.seen.double()
    inside = torch.where(apart, 1.0, seen)
    for _ in range(graph.rounds(_SEAM)):
        inside = torch.minimum(inside, 0.5 * (inside + graph.sum(inside[:, None])[:, 0] / graph.degree))
    step = graph.smoothed(colors, (1 - seen) * ~apart, _SEAM) - graph.smoothed(colors, seen * bare * ~apart, _SEAM)
    step = step * (seen * (1 - inside) * ~others)[:, None]
    image, colors = image + texture.texels.interpolate(step, faces), colors + step
    tone = tone + step
    for weight, most in (
        (bare * places.rim * ~places.brow, _FOLDS),
        (flat, _PORES),
        (frames * ~(places.brow | others), _FRAMED_SKIN),
    ):
        at = texture.texels.interpolate(torch.cat([tone, weight.double()[:, None]], dim=1), faces)
        image = torch.lerp(image, like_skin_around(image, at[:, :3], *most), at[:, 3:])
        colors = torch.lerp(colors, like_skin_around(colors, tone, *most), weight.double()[:, None])
    return replace(texture, image=texture.texels.image(image.clamp(0, 1)), colors=colors.float())


def _filtered(views: Sequence[_View]) -> Tensor:
    """Which photographs show skin of another hue than most, as one with a filter does, (I,) bool."""
    bare = [view.parts.bare > _BARE for view in views]
    if len(views) < _FEWEST or not all(bool(one.any()) for one in bare):
        return torch.zeros(len(views), dtype=torch.bool)
    logs = [view.shown.colors[one].double().clamp(min=_DARK).log() for view, one in zip(views, bare, strict=True)]
    hues = torch.stack([one.median(0).values - one.median(0).values.mean() for one in logs])
    return (hues - hues.median(0).values).norm(dim=1) > _FILTERED


def _bare(colors: Tensor, places: FacePlaces, graph: VertexGraph, brows: bool) -> Tensor:
    """Vertex colours (V,3) with skin for hair, and for brows where photographs show those: others' are not theirs."""
    colors = colors.double()
    skin = colors[places.cheeks].median(0).values
    darker = (skin.clamp(min=_DARK).log() - colors.clamp(min=_DARK).log()).clamp(min=0).norm(dim=1)
    up, behind = places.place[:, 1], places.behind
    scalp = (up > places.brows) | (behind > _SCALP[0]) | ((behind > _SCALP[1]) & (up > _SCALP[2]))
    own = torch.where(scalp & ~places.features, torch.exp(-0.5 * (darker / _AS_DARK).square()), 1.0)
    own = own * ~(places.brow & brows)
    forehead = (up > places.brows) & (places.out < 1) & (own > _BARE) & ~places.features
    skin = colors[forehead if bool(forehead.any()) else places.cheeks].median(0).values
    beside = graph.smoothed(torch.lerp(skin, colors, own[:, None]), own * ~places.features + 1e-3, _TONE)
    return torch.lerp(beside, colors, own[:, None]).float()


def _like_skin(view: _View, graph: VertexGraph) -> Tensor:
    """0 where what is taken for skin ends in other colours than skin, as beside hair and in its shadow, (V,)."""
    shown, parts, places = view.shown, view.parts, view.places
    bare = parts.bare * (shown.cosine > _SQUARE) * ~places.features
    if float(bare.max()) < _BARE:
        return torch.ones_like(bare)
    skin = shown.colors[bare > _BARE].double().median(0).values
    unlike = (skin - shown.colors.double()).clamp(min=0).norm(dim=1) / _UNLIKE  # highlights are skin
    around = graph.smoothed((parts.own * (shown.cosine > _SQUARE))[:, None], torch.ones_like(bare), _AROUND)[:, 0]
    surely = places.features & ~(places.brow & (parts.doubt > _STRANDS))
    return (surely | (around > _WITHIN) | (unlike < 1) | (parts.own - parts.bare > 0.3)).double()


def _capped(texture: PhotoTexture, cap: HairCap, mesh: Mesh, parts: Tensor) -> PhotoTexture:
    """A texture with the hair painted over it, but not over parts (V,) that are no skin."""
    place = cap.places.place
    at = texture.texels.interpolate(torch.cat([place, (~parts).double()[:, None]], dim=1), mesh.faces.cpu())
    image = texture.image.flatten(1)[:, texture.texels.texels].T.double()
    painted = cap.painted(image, at[:, :3], at[:, 3] * cap.share(at[:, :3]))
    colors = cap.painted(texture.colors.double(), place, ~parts * cap.share(place))
    return replace(texture, image=texture.texels.image(painted), colors=colors.float())


def _with_parts(texture: PhotoTexture, colors: Tensor, mesh: Mesh, parts: Tensor, eyes: Tensor) -> PhotoTexture:
    """A texture that shows parts (V,) that are no skin in their colours (V,3), and eyeballs with an iris and a white
    (2,3) and a pupil."""
    iris, white = eyes.double()
    texels, faces = texture.texels, mesh.faces.cpu()
    corners = faces[texels.triangles]
    painted = texels.interpolate(colors.double(), faces)
    for name, mask in mesh.regions.items():
        if part_material(name) is EYEBALL and bool(mask.any()):
            ball = mesh.vertices[mask].detach().cpu().double()
            at = texels.interpolate(mesh.vertices.detach().cpu().double() - (ball.amin(0) + ball.amax(0)) / 2, faces)
            aside = torch.where(at[:, 2] > 0, at[:, :2].norm(dim=1) / (0.5 * IRIS_WIDTH), torch.inf)[:, None]
            ringed = iris * (1.1 - 0.5 * (aside.clamp(max=1) - 0.75).clamp(min=0) / 0.25)  # a dark rim
            black = torch.full_like(ringed, 0.04)
            beyond, outside = (ramp(aside, edge - _SOFT / 2, edge + _SOFT / 2) for edge in (_PUPIL, 1.0))
            eye = torch.lerp(torch.lerp(black, ringed, beyond), white, outside)
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
    upper, lower = (1 - (high - at[:, 1]) / reach).clamp(0, 1), (1 - (at[:, 1] - low) / reach).clamp(0, 1)
    return (1 - 0.5 * upper) * (1 - 0.2 * lower)


def _has_landmarks(mesh: Mesh) -> bool:
    annotations = mesh.annotations
    return annotations is not None and annotations.landmarks is not None and len(annotations.landmarks) == LANDMARKS


def part_vertices(mesh: Mesh) -> Tensor:
    """The vertices of parts that are no skin, by the names of their regions, (V,) bool."""
    result = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    for name, mask in mesh.regions.items():
        if part_material(name) is not None:
            result |= mask.cpu()
    return result


def with_part_colors(mesh: Mesh, iris: Tensor | None) -> Mesh:
    """A head with colours whose parts have those of their materials, and whose eyeballs an iris, sRGB (3,), in
    front."""
    if mesh.colors is None:
        return mesh
    colors = mesh.colors.clone()
    for name, mask in mesh.regions.items():
        material = part_material(name)
        if material is None or not bool(mask.any()):
            continue
        colors[mask] = colors.new_tensor(material.color)
        if material.name in _IN_MOUTH:
            behind = mesh.vertices[mask, 2].max() - mesh.vertices[mask, 2]
            share = ((behind - _MOUTH_BACK[0]) / (_MOUTH_BACK[1] - _MOUTH_BACK[0])).clamp(0, 1)
            light = _MOUTH_LIGHT[0] + (_MOUTH_LIGHT[1] - _MOUTH_LIGHT[0]) * share
            colors[mask] *= light[:, None].to(colors)
        if material is EYEBALL and iris is not None:
            ball = mesh.vertices[mask]
            ahead = torch.nn.functional.normalize(ball - (ball.amin(0) + ball.amax(0)) / 2, dim=1)[:, 2]
            colors[mask.nonzero()[:, 0][ahead > _IRIS_COSINE]] = iris.to(colors)
    return replace(mesh, colors=colors)
