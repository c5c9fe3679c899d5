"""A colour picture of someone, cut out of its background, with landmarks and which of them can be seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.meshes.operators import vertex_normals
from torchface.landmarks.images.ibug_68 import box_around
from torchface.rendering.gaussian_blur import gaussian_blur
from torchface.rendering.raycast import RayCaster, openness
from torchface.synthetic.stages.backdrops import uniform
from torchface.synthetic.stages.face_pictures.expressions import draw_expression
from torchface.synthetic.stages.face_pictures.head_kind import EYEBALL, GUMS, SKIN, TEETH, DrawnHead, HeadKind
from torchface.synthetic.stages.face_pictures.looks import Looks, draw_looks
from torchface.synthetic.stages.face_pictures.picture_geometry import CURTAIN, Surface, annotated, surface
from torchface.synthetic.stages.face_pictures.skin_paint import hair_color, surface_color

SIZE = 192
"""Pixels a side of a picture."""
_BOX = 104.0  # pixels a side of the face's box in it
_CLOSED = 0.3  # millimetres between lids that are closed
_BEHIND = 7.0  # millimetres that a landmark may lie behind what is seen, on a curved edge, and still be visible
_LID_PAIRS = ((37, 41), (38, 40), (43, 47), (44, 46))


@dataclass(frozen=True, eq=False)
class FacePicture:
    """One picture.

    Args:
        rgba: uint8 (4,S,S); the fourth channel is 255 on the person, 0 on what is behind.
        landmarks: iBUG's 68 as an annotator sees them, (68,2) pixels.
        visible: which of them nothing hides, (68,) bool.
        person: its number.
    """

    rgba: Tensor
    landmarks: Tensor
    visible: Tensor
    person: int


@dataclass(frozen=True, eq=False)
class _Person:
    kind: HeadKind
    head: DrawnHead
    looks: Looks


def draw_pictures(
    kinds: Sequence[HeadKind], shares: Sequence[float], first: int, count: int, seed: int, each: int = 4
) -> list[FacePicture]:
    """Pictures by number, each of a person, an expression, a pose and lamps drawn for it.

    Args:
        kinds: of heads.
        shares: how often each kind is drawn.
        first, count: numbers of the pictures; a picture depends on its number and the seed alone.
        seed: decides them.
        each: pictures of one person.
    """
    pictures: list[FacePicture] = []
    someone: _Person | None = None
    for number in range(first, first + count):  # each has a surface of its own
        person = number // each
        if someone is None or number % each == 0:
            someone = _draw_person(kinds, shares, torch.Generator().manual_seed(7_000_003 * seed + 2 * person))
        generator = torch.Generator().manual_seed(7_000_003 * seed + 900_000_000_000 + number)
        pictures.append(replace(_photograph(someone, generator), person=person))
    return pictures


def _draw_person(kinds: Sequence[HeadKind], shares: Sequence[float], generator: torch.Generator) -> _Person:
    kind = kinds[int(torch.multinomial(torch.tensor(list(shares)), 1, generator=generator))]
    return _Person(kind, kind.draw(generator), draw_looks(generator))


def _photograph(person: _Person, generator: torch.Generator) -> FacePicture:
    kind, looks = person.kind, person.looks
    posed = _closed(kind, person.head, draw_expression(generator))
    scene = surface(kind, person.head, posed, looks, generator)
    camera = _camera(kind, posed, generator)
    pixels = camera.project(posed.double())
    landmarks = annotated(kind, pixels, looks).float()
    origins, ways = camera.rays()
    origins, ways = origins.reshape(-1, 3), ways.reshape(-1, 3)
    caster = RayCaster(scene.vertices, scene.faces)
    hits = caster.cast(origins, ways)
    seen = hits.triangle >= 0
    triangle, barycentric, ways = hits.triangle[seen], hits.barycentric[seen].double(), ways[seen]
    points = origins[seen] + hits.distance[seen, None] * ways
    color, gloss = _surface_color(person, scene, triangle, barycentric, points)
    normals = _normals(scene, triangle, barycentric, ways)
    material = scene.material[triangle]
    free = _smooth(openness(caster, points + 0.3 * normals, normals, generator, 2, 45.0), seen)
    light = _lit(caster, camera, points, normals, ways, material, to_linear(color), gloss, free, generator)
    face = (material == SKIN).float()
    exposure = uniform(0.07, 0.42, generator) / float((light.mean(1) * face).sum() / face.sum().clamp(min=1))
    shown = to_srgb((light * exposure).clamp(0, 1))
    image = torch.zeros(SIZE * SIZE, 4)
    image[seen] = torch.cat([shown.float(), torch.ones(len(shown), 1)], dim=1)
    image = image.view(SIZE, SIZE, 4)
    visible = _visible(hits.distance.view(SIZE, SIZE), camera, kind, posed, landmarks)
    if looks.glasses is not None:
        image, hidden = _with_glasses(image, camera, posed[kind.landmarks].double(), looks.glasses, generator)
        visible &= ~hidden
    stored = (255 * image.clamp(0, 1)).round().to(torch.uint8).permute(2, 0, 1).contiguous()
    return FacePicture(stored, landmarks, visible, 0)


def _closed(kind: HeadKind, head: DrawnHead, weights: Tensor) -> Tensor:
    """The head (V,3) at ARKit's weights (52,); lids that are to be closed meet on this head too."""
    own = kind.shapes @ weights
    posed = head.posed(own)
    from torchface.shape_names import ARKIT

    for side, pairs in (("Right", _LID_PAIRS[:2]), ("Left", _LID_PAIRS[2:])):
        row = kind.shapes[:, ARKIT.index(f"eyeBlink{side}")].argmax()
        wanted = float(own[row])
        if wanted < 0.05:
            continue
        ids = kind.landmarks[torch.tensor(pairs)]
        gap = float((posed[ids[:, 0]] - posed[ids[:, 1]])[:, 1].mean())
        unit = float((head.deltas[row, ids[:, 0]] - head.deltas[row, ids[:, 1]])[:, 1].mean())
        opened = gap - wanted * unit
        if unit < -1 and opened > 1:  # a weight of 1 closes
            full = min(max((_CLOSED - opened) / unit, 0.6), 1.35)
            posed = posed + wanted * (full - 1.0) * head.deltas[row]
    return posed


def _camera(kind: HeadKind, posed: Tensor, generator: torch.Generator) -> Camera:
    yaw = (
        float(torch.randn((), generator=generator)) * 20
        if uniform(0, 1, generator) < 0.7
        else uniform(-60, 60, generator)
    )
    # People hold their heads a little lower than heads of databases stand.
    pitch = 5 + 11 * float(torch.randn((), generator=generator).clamp(-2.6, 2.6))
    yaw = max(-65.0, min(65.0, yaw))
    view = 2 * math.degrees(math.atan(0.5 * 220 / math.exp(uniform(math.log(300), math.log(2500), generator))))
    marks = posed[kind.landmarks].double()
    target, span = marks[27:].mean(0), 260.0
    for _ in range(2):  # once for the size, once for the perspective that changes with it
        camera = look_at(target, yaw, pitch, span, SIZE, SIZE, view)
        box = box_around(camera.project(marks).float())
        middle = box[:2] + box[2:] / 2 - (SIZE - 1) / 2
        aside = (middle * span / SIZE).double()
        span = span * float(box[2]) / _BOX
        target = target + aside[0] * camera.rotation[0].double() + aside[1] * camera.rotation[1].double()
    return look_at(target, yaw, pitch, span, SIZE, SIZE, view)


def _surface_color(
    person: _Person, scene: Surface, triangle: Tensor, barycentric: Tensor, points: Tensor
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
    hair = torch.where(material[made] == SKIN, hair, 0.0)
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


def _lit(
    caster: RayCaster,
    camera: Camera,
    points: Tensor,
    normals: Tensor,
    ways: Tensor,
    material: Tensor,
    albedo: Tensor,
    gloss: Tensor,
    free: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Linear light (R,3) under coloured lamps from anywhere in front, above or beside, and a sky."""
    right, down, _ = camera.rotation.double()
    toward_camera = -camera.rotation[2].double()
    starts = points + 0.3 * normals
    sky = torch.nn.functional.normalize(torch.randn(3, generator=generator).double() - 0.8 * down, dim=0)
    even = uniform(0.15, 1.0, generator) * (1 + uniform(0, 0.9, generator) * (normals @ sky))
    even = even * free
    light = even[:, None].float() * _tint(generator, 0.12)
    mirrored = torch.zeros(len(points), 3)
    sharp = torch.where((material == EYEBALL), 220.0, uniform(8, 45, generator)).double()
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
    # Blood under the skin softens and reddens where light ends.
    return albedo.float() * light + gloss[:, None] * mirrored * 0.6


def _tint(generator: torch.Generator, spread: float) -> Tensor:
    warm = spread * float(torch.randn((), generator=generator).clamp(-2, 2))
    return torch.tensor([1 + warm, 1.0, 1 - warm]) * (1 + 0.03 * torch.randn(3, generator=generator))


def _smooth(values: Tensor, seen: Tensor) -> Tensor:
    """Values (R,) of the pixels that are seen (S*S,), blurred over the picture: a few rays a point are noisy."""
    both = torch.zeros(2, SIZE * SIZE)
    both[0, seen], both[1, seen] = values.float(), 1.0
    blurred = gaussian_blur(both.view(1, 2, SIZE, SIZE), 1.2)[0].flatten(1)[:, seen]
    return (blurred[0] / blurred[1].clamp(min=1e-3)).double()


def _visible(distance: Tensor, camera: Camera, kind: HeadKind, posed: Tensor, landmarks: Tensor) -> Tensor:
    """Which landmarks nothing stands before, (68,) bool; contour landmarks count where they are drawn."""
    depth = (posed[kind.landmarks].double() - camera.centre).norm(dim=1)
    nearest = landmarks.round().long().clamp(0, SIZE - 1)
    patch = distance[None, None]
    near = -torch.nn.functional.max_pool2d(-patch, 3, 1, 1)[0, 0]
    far = torch.nn.functional.max_pool2d(torch.where(torch.isfinite(patch), patch, 1e9), 3, 1, 1)[0, 0]
    first = near[nearest[:, 1], nearest[:, 0]]
    last = far[nearest[:, 1], nearest[:, 0]]
    free = last > depth - _BEHIND
    free[:17] = torch.isfinite(first[:17]) & (last[:17] > depth[:17] - 45.0)
    return free


def _with_glasses(
    image: Tensor,
    camera: Camera,
    marks: Tensor,
    form: tuple[float, float, float, float, float],
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Spectacles drawn over an image (H,W,4), and which landmarks they hide (68,)."""
    half_width, half_height, grey, thickness, lens = form
    turn = torch.linspace(0, 2 * math.pi, 41).double()[:-1]
    square = uniform(0.35, 1.0, generator)  # the exponent of a superellipse: 1 is round
    drawn = image.numpy().copy()
    across, up = (way.sign() * way.abs() ** square for way in (turn.cos(), turn.sin()))
    ring = torch.stack([half_width * across, half_height * up, -2 * turn.cos() ** 2], -1)
    curves = [
        marks[eye].mean(0) + torch.tensor([0.0, -2.0, 13.0]).double() + ring for eye in (slice(36, 42), slice(42, 48))
    ]
    hidden = torch.zeros(68, dtype=torch.bool)
    tone = grey * torch.tensor([1.0, 0.9, 0.8]).numpy()
    for number, curve in enumerate(curves):
        line = (camera.project(curve).numpy() * 16).round().astype("int32")
        cover = drawn[..., 0] * 0
        cv2.fillPoly(cover, [line], 1.0, cv2.LINE_AA, 4)
        shade = uniform(0.0, 0.25, generator) if uniform(0, 1, generator) < 0.3 else 0.0  # a mirrored window
        inside = cover[..., None] * (drawn[..., 3:] > 0)
        drawn[..., :3] = drawn[..., :3] * (1 - lens * inside) + inside * (0.03 * lens + shade)
        hidden[36 + 6 * number : 42 + 6 * number] = lens > 0.8
    bridge = torch.stack([curves[0][0], curves[1][20]])
    arms = [torch.stack([curve[row], ear]) for curve, row, ear in zip(curves, (20, 0), marks[[0, 16]], strict=True)]
    width = max(1, round(thickness))
    for curve in (*curves, bridge, *arms):
        line = (camera.project(curve).numpy() * 16).round().astype("int32")
        cv2.polylines(drawn, [line], len(curve) > 2, (*map(float, tone), 1.0), width, cv2.LINE_AA, 4)
    return torch.from_numpy(drawn), hidden
