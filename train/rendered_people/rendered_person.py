"""Rendering of a person: the colour of each pixel under light sources, and its depth."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.rendering.gaussian_blur import gaussian_blur
from torchface.rendering.raycast import Hits, RayCaster
from torchface.synthetic.head.identity import ramp

from .backdrops import uniform
from .head_kind import EYEBALL, GUMS, SKIN, SOCKET, TEETH
from .people import Person
from .picture_geometry import CURTAIN, Surface
from .skin_paint import hair_color, surface_color

_WHITE = 0.75  # of the brightest light that an eye's white may have
_FEW = 8  # pixels of eyeballs


@dataclass(frozen=True, eq=False)
class RenderedPerson:
    """What a camera sees."""

    image: Tensor  # colours with a fourth channel that is 1 on the person, 0 on what is behind, (H,W,4) sRGB
    distance: Tensor  # (H,W) millimetres, infinite where there is nothing
    material: Tensor  # (H,W), -1 where there is nothing
    exposure: float  # what the light was multiplied by
    hits: Hits  # of the rays through the pixels, in rows from the top


def render_person(
    person: Person,
    scene: Surface,
    camera: Camera,
    generator: torch.Generator,
    rays: torch.Generator | None = None,
    exposure: float | None = None,
) -> RenderedPerson:
    """Shows someone to a camera.

    Args:
        camera: from where.
        generator: of the light sources and the exposure.
        rays: of the few rays a point that distinguish open places from hollow ones; ``generator`` if absent. With one
            of their own the light sources are the same however much of the picture someone fills.
        exposure: another picture's; if absent it is drawn, for how light the skin and the eyes' whites are.
    """
    height, width = camera.height, camera.width
    origins, ways = camera.rays()
    origins, ways = origins.reshape(-1, 3), ways.reshape(-1, 3)
    caster = RayCaster(scene.vertices, scene.faces)
    hits = caster.cast(origins, ways)
    seen = hits.triangle >= 0
    materials = torch.where(seen, scene.material[hits.triangle.clamp(min=0)], -1)
    pixel, count = seen.nonzero()[:, 0], int(seen.sum())
    finer, more, aside = _finer_rays(caster, camera, materials.view(height, width))
    pixel = torch.cat([pixel, finer])
    triangle = torch.cat([hits.triangle[seen], more.triangle])
    barycentric = torch.cat([hits.barycentric[seen], more.barycentric]).double()
    ways = torch.cat([ways[seen], aside])
    points = origins[pixel] + torch.cat([hits.distance[seen], more.distance])[:, None] * ways
    color, gloss = _surface_color(person, scene, triangle, barycentric, points)
    normals = _normals(scene, triangle, barycentric, ways)
    material = scene.material[triangle]
    free = openness(caster, points[:count] + 0.3 * normals[:count], normals[:count], rays or generator, 2, 45.0)
    frees = torch.ones(height * width).double()
    frees[seen] = _smooth(free, seen.view(height, width))
    surface = _SeenSurface(points, normals, ways, material, to_linear(color), gloss, frees[pixel])
    light = _lit(caster, camera, surface, generator)
    if exposure is None:
        exposure = _exposure(light[:count].mean(1), material[:count], uniform(0.07, 0.42, generator))
    lights = torch.zeros(height * width, 3).index_add_(0, pixel, (light * exposure).clamp(0, 1).float())
    lights = lights / torch.bincount(pixel, minlength=height * width).clamp(min=1)[:, None]
    image = torch.cat([to_srgb(lights) * seen[:, None], seen[:, None].float()], dim=1)
    distance = hits.distance.view(height, width)
    return RenderedPerson(image.view(height, width, 4), distance, materials.view(height, width), exposure, hits)


def _finer_rays(caster: RayCaster, camera: Camera, materials: Tensor) -> tuple[Tensor, Hits, Tensor]:
    """Four rays more through each pixel of eyes and mouths and of their edges, where what is seen is small: the
    pixels (N,), what the rays hit, their directions (N,3)."""
    small = (materials >= TEETH) & (materials <= SOCKET)
    small = torch.nn.functional.max_pool2d(small.float()[None, None], 3, 1, 1)[0, 0] > 0
    pixels = (small & (materials >= 0)).flatten().nonzero()[:, 0]
    ways = camera.rays(2)[1].view(camera.height, 2, camera.width, 2, 3).transpose(1, 2).reshape(-1, 4, 3)
    way = ways[pixels].reshape(-1, 3)
    hits = caster.cast(camera.centre.double().expand_as(way), way)
    hit = hits.triangle >= 0
    return (
        pixels.repeat_interleave(4)[hit],
        Hits(hits.triangle[hit], hits.barycentric[hit], hits.distance[hit]),
        way[hit],
    )


def _exposure(light: Tensor, material: Tensor, skin: float) -> float:
    """What light (R,) is multiplied by to show skin as light as this in the mean, and no eyes as white patches."""
    face = (material == SKIN).float()
    exposure = skin / float((light * face).sum() / face.sum().clamp(min=1))
    whites = light[material == EYEBALL]
    return min(exposure, _WHITE / float(whites.quantile(0.8))) if len(whites) > _FEW else exposure


def _surface_color(
    person: Person, scene: Surface, triangle: Tensor, barycentric: Tensor, points: Tensor
) -> tuple[Tensor, Tensor]:
    """sRGB colours (R,3) of points, and how much light they mirror (R,)."""
    kind, looks = person.kind, person.looks
    material = scene.material[triangle]
    color = looks.clothes.expand(len(points), 3).clone()
    pattern = 0.5 + 0.5 * torch.sin(points[:, :2].float() @ torch.tensor([[0.0, 0.35], [0.6, 0.1]])[looks.seed % 2])
    color = color * (1 - (0.35 if looks.seed % 3 == 0 else 0.0) * pattern[:, None])
    gloss = torch.zeros(len(points))
    of_head = material < CURTAIN
    corners = scene.faces[triangle]
    made = of_head & (corners < len(kind.canonical)).all(1)
    rows, weights = corners[made], barycentric[made].float()
    table = torch.cat([kind.canonical.float(), kind.marks, scene.hair[:, None]], dim=1)
    values = (table[rows] * weights[..., None]).sum(1)
    canonical, marks, hair = values[:, :3], values[:, 3:11], values[:, 11]
    skin = surface_color(canonical, marks, material[made], looks, kind.brow_lift)
    hair = torch.where(material[made] == SKIN, ramp(hair, 0.05, 0.5), 0.0)  # skin under it does not show
    skin = torch.lerp(skin, hair_color(canonical, looks), (0.98 * hair)[:, None])
    color[made] = skin
    shine = torch.full((len(skin),), looks.gloss) * (1 - hair) + 0.06 * hair
    shine[(material[made] == TEETH) | (material[made] == GUMS)] = 0.25
    shine[material[made] == EYEBALL] = 0.9
    shine = torch.where((marks[:, 0] > 0.5) & (material[made] == SKIN), 1.8 * shine + 0.02, shine)
    gloss[made] = shine
    hanging = material == CURTAIN
    color[hanging] = hair_color(points[hanging].float(), looks)
    gloss[hanging] = 0.06
    color[of_head & ~made] = torch.tensor([0.86, 0.82, 0.75])
    return color.clamp(0.005, 0.99), gloss


def _normals(scene: Surface, triangle: Tensor, barycentric: Tensor, ways: Tensor) -> Tensor:
    smooth = vertex_normals(scene.vertices, scene.faces)
    normals = (smooth[scene.faces[triangle]] * barycentric[..., None]).sum(1)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    return torch.where((normals * ways).sum(-1, keepdim=True) > 0, -normals, normals)


@dataclass(frozen=True, eq=False)
class _SeenSurface:
    """What R rays of a camera meet."""

    points: Tensor  # (R,3)
    normals: Tensor  # outward, (R,3)
    ways: Tensor  # the rays' directions, (R,3)
    material: Tensor  # (R,)
    albedo: Tensor  # linear, (R,3)
    gloss: Tensor  # how much light is mirrored, (R,)
    free: Tensor  # how much of the sky is open, (R,)


def _lit(caster: RayCaster, camera: Camera, seen: _SeenSurface, generator: torch.Generator) -> Tensor:
    """Linear light (R,3) under coloured lights in front, above or beside, and indoors."""
    points, normals, ways, gloss = seen.points, seen.normals, seen.ways, seen.gloss
    right, down, _ = camera.rotation.double()
    toward_camera = -camera.rotation[2].double()
    starts = points + 0.3 * normals
    light = _room_light(normals, down, generator) * seen.free[:, None].float()
    mirrored = torch.zeros(len(points), 3)
    sharp = torch.where((seen.material == EYEBALL), 220.0, uniform(8, 45, generator)).double()
    for number in range(int(uniform(0.5, 3.6, generator))):
        x, y = torch.randn(2, generator=generator).tolist()
        toward = x * right - (0.4 + y) * down + uniform(-0.2, 1.6, generator) * toward_camera
        toward = torch.nn.functional.normalize(toward, dim=0)
        strength = uniform(0.15, 1.1, generator) * (1.0 if number == 0 else 0.5)
        soft = uniform(0.0, 0.5, generator)
        falls = ((normals @ toward + soft) / (1 + soft)).clamp(min=0)
        if uniform(0, 1, generator) < 0.6:
            dark = caster.occluded(starts, toward.expand_as(starts))
            falls = falls * torch.where(dark, uniform(0.0, 0.5, generator), 1.0)
        tint = _tint(generator, 0.2)
        light = light + strength * falls[:, None].float() * tint
        half = torch.nn.functional.normalize(toward - ways, dim=-1)
        shine = (normals * half).sum(-1).clamp(min=0) ** sharp * (falls > 0)
        mirrored = mirrored + strength * shine[:, None].float() * tint
    # Lips keep most light from what is behind them, a light source's too.
    behind = (seen.material == TEETH) | (seen.material == GUMS) | (seen.material == SOCKET)
    reached = torch.where(behind, seen.free.clamp(0, 1), 1.0).float()[:, None]
    return (seen.albedo.float() * light + gloss[:, None] * mirrored * 0.6) * reached


def _room_light(normals: Tensor, down: Tensor, generator: torch.Generator) -> Tensor:
    """Light (R,3) of broad coloured areas: a sky or a ceiling, and walls or windows or screens beside."""
    light = torch.full((len(normals), 3), uniform(0.08, 0.6, generator))
    for number in range(int(uniform(1, 4, generator))):
        way = torch.randn(3, generator=generator).double() - (1.2 if number == 0 else 0.2) * down
        facing = 0.5 + 0.5 * (normals @ torch.nn.functional.normalize(way, dim=0))
        falls = facing ** uniform(1, 3, generator)
        light = light + uniform(0.05, 0.8, generator) * falls[:, None].float() * _tint(generator, 0.15)
    return light * _tint(generator, 0.08)


def _tint(generator: torch.Generator, spread: float) -> Tensor:
    warm = spread * float(torch.randn((), generator=generator).clamp(-2, 2))
    return torch.tensor([1 + warm, 1.0, 1 - warm]) * (1 + 0.03 * torch.randn(3, generator=generator))


def _smooth(values: Tensor, seen: Tensor) -> Tensor:
    """Values (R,) of the pixels that are seen (H,W), blurred over the picture: a few rays a point are noisy."""
    both = torch.zeros(2, *seen.shape)
    both[0, seen], both[1, seen] = values.float(), 1.0
    blurred = gaussian_blur(both[None], 1.2)[0][:, seen]
    return (blurred[0] / blurred[1].clamp(min=1e-3)).double()


def visible_points(distance: Tensor, camera: Camera, points: Tensor, pixels: Tensor, behind: Tensor | float) -> Tensor:
    """Which points (N,3) of a head, drawn at pixels (N,2), nothing in a picture of distances (H,W) stands before,
    (N,) bool; each may lie (N,) millimetres ``behind`` what is seen."""
    depth = (points - camera.centre).norm(dim=1)
    x, y = pixels[:, 0].round().long(), pixels[:, 1].round().long()
    x, y = x.clamp(0, camera.width - 1), y.clamp(0, camera.height - 1)
    patch = distance[None, None]
    near = -torch.nn.functional.max_pool2d(-patch, 3, 1, 1)[0, 0]
    far = torch.nn.functional.max_pool2d(torch.where(torch.isfinite(patch), patch, 1e9), 3, 1, 1)[0, 0]
    return torch.isfinite(near[y, x]) & (far[y, x] > depth - behind)


def openness(
    caster: RayCaster, starts: Tensor, normals: Tensor, generator: torch.Generator, count: int, reach: float
) -> Tensor:
    """The share of the hemisphere over points (R,3), a little above the surface, that is free within reach, by
    ``count`` rays a point, (R,) float64."""
    free = torch.zeros(len(starts))
    for _ in range(count):  # a ray of each point a turn
        way = normals + torch.nn.functional.normalize(torch.randn(normals.shape, generator=generator).double(), dim=-1)
        way = torch.nn.functional.normalize(way + 1e-6, dim=-1)
        free += caster.distances(starts, way, reach)
    return free.double() / (count * reach)
