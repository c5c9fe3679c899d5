"""Photographs as a head's texture: blended by viewing angle, seams hidden, completed where none shows the skin."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError, TopologyError
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import border_vertices, components, edges
from torchface.geometry.meshes.rasterization import TexelMap, rasterise_uvs
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.mesh import Mesh
from torchface.modeling.photographs.skin_light import unlit
from torchface.rendering.camera_visibility import PosedSurface, Shown, shown_in
from torchface.rendering.environment_light import EnvironmentLight

_SQUARELY = 0.2
_MIN_CONFIDENCE = 0.5
_SHARP, _SLANT, _FADE = 3.0, 0.05, 0.5
_BENDS = 8  # rounds by which the cosine is smoothed
_FEATHER, _BROAD, _FILL = 6, 60, 400
_TYPICAL, _SPARSE = 0.15, 0.05
_LIPS = 6.0  # millimetres around their inner landmarks
_HEAT_LOSS, _HEAT_LOSS_AT_MASK = 0.004, 0.01  # a ring of vertices, relative
_MAX_GAIN = 4.0
_DARK, _MAX_TONE = 0.05, 0.5
_NEVER_SEEN = (0.72, 0.68, 0.66)  # parts that no photograph shows, such as teeth behind lips


@dataclass(frozen=True, eq=False)
class PhotoTexture:
    """A texture made of photographs.

    Args:
        image: (3,size,size), first row on top.
        colors: of the vertices, (V,3).
        seen: how much of each vertex's colour comes from photographs, (V,) in [0,1].
        texels: which of the image lie on the head.
    """

    image: Tensor
    colors: Tensor
    seen: Tensor
    texels: TexelMap


def photo_texture(
    posed: Mesh | Sequence[Mesh],
    images: Sequence[Tensor],
    cameras: Sequence[Camera],
    size: int = 1024,
    base: Tensor | None = None,
    confidence: Tensor | None = None,
    lights: Sequence[EnvironmentLight | None] | None = None,
    patches: Sequence[Tensor] | None = None,
) -> PhotoTexture:
    """Projects photographs onto a head.

    Each texel takes the photographs that see it, the squarest most. Weights, made on the vertices, go to zero over
    the mesh before a photograph ends, so that no edge of one shows, also not where the layout is cut. What photographs
    differ in broadly (exposure, white balance, shading) is brought to their mean, detail is kept from the squarest.
    Where none shows the skin, the mirror image of the other side is taken, then the base; both are toned to what is
    next to them.

    Args:
        posed: the head as the photographs show it, or as each of them does, with texture coordinates.
        images: photographs, (3,H,W) each.
        cameras: one each.
        size: texels a side.
        base: colours for what no photograph shows, (V,3), such as ``fit_colors`` gives; those nearby if absent.
        confidence: that each photograph shows the head at each vertex, (I,V) in [0,1], such as ``skin_shares`` gives;
            everywhere if absent.
        lights: of each photograph, which is divided out; see ``skin_light``. Colours stay as they are if absent.
        patches: what is added to each photograph's colours at the vertices then, (V,3) each; see ``patch_offset``.

    Raises:
        ShapeError: not one camera an image, an image of another size than its camera's, or a base of another shape.
        TopologyError: the mesh has no texture coordinates.
        AlignmentError: no photograph shows the head.

    Source: thesis 3.2.5, algorithm 3; Burt and Adelson 1983 (bands blended apart).

    Example:
        >>> from torchface.geometry.cameras.pinhole import look_at
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> camera = look_at(head.vertices[head.landmarks].mean(0), 0.0, width=60, height=80)
        >>> red = torch.tensor([0.8, 0.2, 0.2])[:, None, None].repeat(1, 80, 60)
        >>> texture = photo_texture(head, [red], [camera], size=64)
        >>> nose = head.landmarks[30]
        >>> bool(texture.colors[nose, 0] > 0.7 > texture.colors[nose, 1])
        True
    """
    if len(images) != len(cameras) or not images:
        raise ShapeError(f"photo_texture: found {len(images)} images and {len(cameras)} cameras, expected one each")
    surfaces = PosedSurface.each(posed, len(images))
    mesh = posed if isinstance(posed, Mesh) else posed[0]
    if mesh.uvs is None or mesh.uv_faces is None:
        raise TopologyError("photo_texture: found a mesh without texture coordinates, expected some to lay it out in")
    if base is not None and base.shape != mesh.vertices.shape:
        raise ShapeError(f"base: found {tuple(base.shape)}, expected {tuple(mesh.vertices.shape)}")
    vertices, faces = surfaces[0].vertices, mesh.faces.cpu()
    graph = VertexGraph(faces, len(vertices), vertices)
    at_vertices = [
        surface.shown_in(image, camera) for surface, image, camera in zip(surfaces, images, cameras, strict=True)
    ]
    lights = [None] * len(images) if lights is None else lights
    patches = [torch.zeros_like(vertices)] * len(images) if patches is None else patches
    at_vertices = [
        replace(
            shown,
            colors=unlit(shown.colors, surface.normals, camera, light) + patch,
            # Under a brow and at a nose's wing skin is seen at a slant and yet is none's edge.
            cosine=(shown.cosine > 0)
            * graph.smoothed(shown.cosine[:, None].double(), (shown.cosine > 0).double(), _BENDS)[:, 0],
        )
        for shown, surface, camera, light, patch in zip(at_vertices, surfaces, cameras, lights, patches, strict=True)
    ]
    outside = _outer_border(vertices, faces)
    confidences = (
        torch.ones(len(images), len(vertices), dtype=torch.float64) if confidence is None else confidence.cpu().double()
    )
    cosines = torch.stack([shown.cosine for shown in at_vertices])
    squareness = ((cosines - _SQUARELY) / (1 - _SQUARELY)).clamp(min=0) ** _SHARP  # in [0,1]
    inside = torch.stack([
        _inside((shown.cosine > _SQUARELY) & (one >= _MIN_CONFIDENCE) & ~outside, graph)
        for shown, one in zip(at_vertices, confidences, strict=True)
    ])  # fmt: skip
    weights = squareness * inside
    soft = torch.stack([_feathered((one >= _MIN_CONFIDENCE).double(), graph) for one in confidences]).amax(0)
    if float(weights.max()) <= 0:
        raise AlignmentError("images: found no vertex of the head in any of them, expected cameras that see it")
    gains = _gains(at_vertices, weights)
    toned = [shown.colors.double() * gain for shown, gain in zip(at_vertices, gains, strict=True)]
    blended, offsets = _blended(toned, weights, graph)
    # A photograph that sees skin at a slant counts in full where it is the only one; where it ends it fades.
    fade = ((inside / _FADE).clamp(max=1) * (squareness / _SLANT).clamp(max=1)).amax(0) * soft
    alpha = fade**2 * (3 - 2 * fade)
    filled = _filled(mesh, blended, alpha, base, graph, confidence is not None)
    colors = torch.lerp(filled, blended, alpha[:, None])
    texels = rasterise_uvs(mesh.uvs.cpu(), mesh.uv_faces.cpu(), size, size)
    total, values = torch.zeros(2, 1, 1, dtype=torch.float64)
    for i, (at, image, camera, light, patch) in enumerate(
        zip(surfaces, images, cameras, lights, patches, strict=True)
    ):  # a ray a texel
        points = texels.interpolate(at.vertices, faces)
        outward = torch.nn.functional.normalize(texels.interpolate(at.normals, faces), dim=-1)
        shown = shown_in(image.cpu(), camera, at.caster, points, outward)
        weight = texels.interpolate(weights[i, :, None], faces) * (shown.cosine[:, None] > 0)
        tone = texels.interpolate(offsets[i], faces)
        own = unlit(shown.colors, outward, camera, light).double() + texels.interpolate(patch.double(), faces)
        values = values + weight * (own * gains[i] + tone)
        total = total + weight
    under = texels.interpolate(filled, faces)
    share = texels.interpolate(alpha[:, None], faces) * (total > 0)
    values = torch.lerp(under, values / total.clamp(min=1e-9), share).clamp(0, 1)
    return PhotoTexture(texels.image(values), colors.clamp(0, 1).float(), alpha.float(), texels)


def _outer_border(vertices: Tensor, faces: Tensor) -> Tensor:
    """The vertices (V,) of the widest opening, where the mesh ends but the person does not."""
    border = border_vertices(faces, len(vertices))
    along = edges(faces)
    label = components(along[border[along].all(1)][:, [0, 1, 1]], len(vertices))
    result = torch.zeros(len(vertices), dtype=torch.bool)
    names = label[border].unique()
    if len(names):
        widths = [float((vertices[label == k].amax(0) - vertices[label == k].amin(0)).norm()) for k in names]
        result = (label == names[int(torch.tensor(widths).argmax())]) & border
    return result


def _inside(shown: Tensor, graph: VertexGraph) -> Tensor:
    """1 well inside what a photograph shows of the head (V,) bool, falling to 0 before it ends."""
    inner = shown.double()
    for _ in range(2):  # rings of vertices: those at an edge show what lies behind it as soon as the fit is inexact
        inner = graph.least(inner)
    return _feathered(inner, graph)


def _feathered(inner: Tensor, graph: VertexGraph) -> Tensor:
    """What is 1 (V,), falling to 0 before it ends."""
    soft = inner
    for _ in range(_FEATHER):
        soft = torch.minimum(inner, 0.5 * (soft + graph.sum(soft[:, None])[:, 0] / graph.degree))
    return soft


def _gains(shown: Sequence[Shown], weights: Tensor) -> Tensor:
    """What each photograph's channels are multiplied by so that they agree where they overlap, (I,3)."""
    count = len(shown)
    logs = torch.stack([one.colors.double().clamp(0.02, 0.98).log() for one in shown])
    H = torch.full((count, count), 1e-6, dtype=torch.float64) + 1e-6 * torch.eye(count, dtype=torch.float64)
    g = torch.zeros(count, 3, dtype=torch.float64)
    for i in range(count):  # pairs of photographs
        for j in range(i):
            both = (weights[i] * weights[j]).sqrt()
            if float(both.sum()) < 1e-6:
                continue
            ratio = logs[i] - logs[j]
            middle = ratio[both > 0].median(0).values
            confidence = both * (1 / (1 + ((ratio - middle) / 0.2).square().sum(-1)))
            step = (confidence[:, None] * ratio).sum(0) / confidence.sum()
            strength = confidence.sum()
            H[i, i] += strength
            H[j, j] += strength
            H[i, j] -= strength
            H[j, i] -= strength
            g[i] -= strength * step
            g[j] += strength * step
    return torch.linalg.solve(H, g).exp().clamp(1 / _MAX_GAIN, _MAX_GAIN)


def _blended(toned: Sequence[Tensor], weights: Tensor, graph: VertexGraph) -> tuple[Tensor, Tensor]:
    """The vertices' colours (V,3), and what brings each photograph's broad tone to the mean, (I,V,3)."""
    colors = torch.stack(list(toned))
    mean = (weights[..., None] * colors).sum(0) / weights.sum(0).clamp(min=1e-12)[:, None]
    offsets = torch.stack([
        graph.smoothed(mean - color, weight, _BROAD) for color, weight in zip(colors, weights, strict=True)
    ])  # fmt: skip
    corrected = (weights[..., None] * (colors + offsets)).sum(0) / weights.sum(0).clamp(min=1e-12)[:, None]
    return corrected, offsets


def _filled(mesh: Mesh, colors: Tensor, alpha: Tensor, base: Tensor | None, graph: VertexGraph, masked: bool) -> Tensor:
    """Colours (V,3) where no photograph shows the skin: the mirror image, the base, else what is nearest, toned.

    What is nearest is the pixel at the edge where the photograph ends, and a broad mean where a mask ends it.
    """
    covered, guess = alpha.clone(), colors * alpha[:, None]
    mirror = None if mesh.annotations is None else mesh.annotations.mirror
    if mirror is not None:
        there = alpha[mirror.cpu()]
        other = colors[mirror.cpu()]
        # The other side stands in other light, in one factor: channels apart would tint what is dark.
        other = _toned(other, colors, alpha * there, graph, _BROAD, apart=False)
        guess = guess + ((1 - alpha) * there)[:, None] * other
        covered = covered + (1 - alpha) * there
    mean = (
        colors[alpha > 0.5].median(0).values
        if bool((alpha > 0.5).any())
        else (guess * alpha[:, None]).sum(0) / alpha.sum()
    )
    if base is not None:
        under = base.detach().cpu().double()
        # The tone at the edge of what is covered counts, not that of the face as a whole, nor that of what the edge
        # still shows of hair.
        edge = graph.smoothed(1 - covered[:, None], torch.ones_like(covered), _FEATHER)[:, 0]
        seen_color = guess / covered.clamp(min=1e-9)[:, None]
        typical = covered * _typical(seen_color, mean)
        # Far from any edge, as at the neck, the base has the face's hue: that of the light is known roughly alone.
        under = under * _median_ratio(seen_color, under, typical > 0.5)
        weight = (edge + 1e-3) * typical
        return guess + (1 - covered)[:, None] * _toned(under, seen_color, weight, graph, _FILL)
    label = components(mesh.faces.cpu(), len(alpha))
    shown = torch.zeros(int(label.max()) + 1, dtype=torch.float64).index_add_(0, label, covered)
    mean = torch.where((shown > 0)[label][:, None], mean, torch.tensor(_NEVER_SEEN, dtype=torch.float64))
    fixed = (covered > 0.5)[:, None]
    seen_color = guess / covered.clamp(min=0.5)[:, None]
    if masked:  # lips, brows and what the edge still shows of hair are not spread
        typical = covered * _typical(seen_color, mean)
        weight = graph.smoothed(typical[:, None], torch.ones_like(covered), _BROAD)
        seen_color = torch.lerp(mean, graph.smoothed(seen_color, typical, _BROAD), weight / (weight + _SPARSE))
    under = torch.where(fixed, seen_color, mean)
    lost = (_HEAT_LOSS_AT_MASK if masked else _HEAT_LOSS) / graph.finer
    # Heat flows from what is covered; behind a mask it is lost.
    for _ in range(0 if bool(fixed.all()) else graph.rounds(_FILL)):
        under = torch.where(fixed, under, torch.lerp(graph.sum(under) / graph.degree[:, None], mean, lost))
    marks = None if mesh.annotations is None else mesh.annotations.landmarks
    if marks is not None and len(marks) == 68:  # lips that touch hide their rims, which are lips too
        at = mesh.vertices.detach().cpu().double()
        lips = torch.cdist(at, at[marks[60:].cpu()]).amin(1) < _LIPS
        lips &= (at[:, 0] > at[marks[60], 0]) & (at[:, 0] < at[marks[64], 0])
        seen = lips & (covered > 0.5)
        under = torch.where((lips & ~seen)[:, None], colors[seen].median(0).values, under) if seen.any() else under
    return guess + (1 - covered)[:, None] * under


def _typical(colors: Tensor, mean: Tensor) -> Tensor:
    """How much colours (V,3) are like a mean, (V,) in [0,1]."""
    return torch.exp(-0.5 * ((colors - mean) / _TYPICAL).square().sum(-1))


def _median_ratio(goal: Tensor, colors: Tensor, where: Tensor) -> Tensor:
    """How much brighter a goal (V,3) is than colours (V,3) where (V,) they are compared, (3,)."""
    if not bool(where.any()):
        return torch.ones(3, dtype=colors.dtype)
    ratio = goal[where].clamp(min=_DARK).log() - colors[where].clamp(min=_DARK).log()
    return ratio.median(0).values.clamp(-_MAX_TONE, _MAX_TONE).exp()


def _toned(
    colors: Tensor, goal: Tensor, weights: Tensor, graph: VertexGraph, iterations: int, apart: bool = True
) -> Tensor:
    """Colours (V,3) times what makes them as bright as a goal where weights (V,) compare them, carried on beyond."""
    ratio = goal.clamp(min=_DARK).log() - colors.clamp(min=_DARK).log()
    ratio = ratio if apart else ratio.mean(-1, keepdim=True)
    return colors * graph.smoothed(ratio, weights, iterations).clamp(-_MAX_TONE, _MAX_TONE).exp()
