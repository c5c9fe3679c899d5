"""Grey portraits of synthetic people with exact landmarks, as varied as a landmark detector needs to learn from."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.meshes.operators import vertex_normals
from torchface.landmarks.images.ibug_68 import box_around
from torchface.progress import Progress, silent
from torchface.rendering.clay_shading import sample_texture
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig
from torchface.synthetic import IDENTITY, draw_identities, performer
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import ramp, sculpted_vertices
from torchface.synthetic.stages.weight_curves import GESTURES

from .backdrops import backdrop, photographed, uniform
from .complexion import complexion_colors, draw_complexions
from .portrait_geometry import Hairdo, annotated_landmarks, hair_share, portrait, widened
from .rendered_person import openness

_SENSITIVITY = torch.tensor([0.35, 0.5, 0.15])
# What people in photographs have more or less of than the mean head, standard deviations: width, most of all.
_LEANING = {"face_width": 1.2, "jaw_width": 1.3, "cheek_fullness": 1.0, "head_width": 0.8, "pupil_distance": -0.4,
            "face_height": 0.4, "chin_height": 0.4, "mouth_width": 0.6, "brow_height": 0.5}  # fmt: skip
_REFERENCE = 220  # pixels a side that rays are cast for; the image is then made smaller or a little larger


@dataclass(frozen=True)
class FaceImageSettings:
    """What is drawn how widely; angles in degrees."""

    yaw: float = 20.0  # standard deviation of the head's pose; none beyond 2.4 of them
    pitch: float = 9.0  # as yaw
    roll: float = 9.0  # as yaw
    smallest: int = 90  # height of the images, pixels; the face fills about half
    largest: int = 280
    each: int = 3  # images of one person
    spread: float = 1.3  # of identities, 1 as varied as people are


@dataclass(frozen=True, eq=False)
class FaceImage:
    """An image and the truth about it."""

    image: Tensor  # grey, uint8 (H,W)
    landmarks: Tensor  # iBUG's 68, (68,2) pixels, as an annotator sees them: see annotated_landmarks
    box: Tensor  # x, y, width, height round the face as a detector draws it, (4,) pixels
    person: int


@dataclass(frozen=True, eq=False)
class _Person:
    """Someone's rig, hair, by what skin is darker or lighter at each vertex (V,), and how much wider the face is."""

    rig: BlendshapeRig
    hairdo: Hairdo
    hair: Tensor
    hair_grey: float
    texture: Tensor
    tint: Tensor
    eyes: tuple[float, float]
    teeth: float
    clothes: float
    glasses: tuple[float, float, float] | None
    width: float


def face_images(
    count: int, seed: int, settings: FaceImageSettings | None = None, progress: Progress | None = None, first: int = 0
) -> Iterator[FaceImage]:
    """Draws people, poses, expressions, lights and backgrounds, one image at a time, from number ``first`` on.

    An image depends on its number and the seed, not on how many are asked for.
    """
    progress = progress or silent
    settings = settings or FaceImageSettings()
    someone = None
    for number in range(first, first + count):  # each has a surface of its own
        if someone is None or number % settings.each == 0:
            person = torch.Generator().manual_seed(1_000_003 * seed + 500_000_000_000 + number // settings.each)
            someone = _draw_person(settings, person)
        generator = torch.Generator().manual_seed(1_000_003 * seed + number)
        yield replace(_render(someone, settings, generator), person=number // settings.each)
        progress("rendering portraits", number + 1 - first, count)


def _draw_person(settings: FaceImageSettings, generator: torch.Generator) -> _Person:
    leaning = torch.tensor([_LEANING.get(parameter.name, 0.0) for parameter in IDENTITY])
    rig = performer(draw_identities(1, generator, settings.spread)[0] + leaning)
    mesh = rig.neutral
    assert mesh.texture is not None
    texture = torch.einsum("chw,c->hw", mesh.texture, _SENSITIVITY)[None]
    drawn = draw_complexions(1, generator, 1.1)[0]
    drawn[0] = uniform(-1.5, 2.6, generator)  # pigment: as many dark faces as light ones
    drawn[3] = uniform(-2.5, 2.0, generator)
    grey = complexion_colors(torch.stack([drawn, torch.zeros_like(drawn)])) @ _SENSITIVITY
    tint = grey[0] / grey[1].clamp(min=0.02) * _facial_hair(generator)

    def chance(share: float) -> bool:
        return uniform(0, 1, generator) < share

    hairdo = Hairdo(
        uniform(0, 26, generator) if chance(0.85) else 0.0,
        uniform(-30, -14, generator) if chance(0.2) else uniform(-8, 18, generator),
        uniform(20, 220, generator) if chance(0.35) else 0.0,
        uniform(52, 85, generator),
    )
    hair = 0.98 * hair_share(hairdo.hairline).float() * (hairdo.thickness > 0)
    hair_grey = uniform(0.03, 0.22, generator) if chance(0.75) else uniform(0.2, 0.75, generator)
    glasses = (
        (uniform(17, 27, generator), uniform(11, 20, generator), uniform(0.0, 0.5, generator)) if chance(0.12) else None
    )
    return _Person(
        rig, hairdo, hair, hair_grey, texture, tint, (uniform(0.5, 2.2, generator), uniform(0.7, 1.1, generator)),
        uniform(0.7, 1.5, generator), uniform(0.03, 0.9, generator), glasses,
        max(-0.05, min(0.22, 0.08 + 0.06 * float(torch.randn((), generator=generator)))),
    )  # fmt: skip


def _facial_hair(generator: torch.Generator) -> Tensor:
    """What beard, moustache and shaven shadow leave of the skin's grey, (V,)."""
    if uniform(0, 1, generator) > 0.4:
        return torch.ones(len(sculpted_vertices()))
    p, regions = sculpted_vertices(), head_annotations().regions
    x, y, z = p[:, 0].abs(), p[:, 1], p[:, 2]
    lips = regions["upper_lip"] | regions["lower_lip"] | regions["mouth_interior"]
    front = ramp(z, -5, 15)
    edge = -62.0 + 0.012 * (x - 20).clamp(min=0) ** 2 + uniform(-12, 4, generator)
    beard = ramp(edge - y, 0, 9) * front * ramp(y, -140, -118)
    moustache = ramp(-44.5 - y, 0, 5) * (1 - ramp(-y, 68, 76)) * (1 - ramp(x, 26, 34)) * ramp(z, 60, 75)
    amount = uniform(0.1, 1.0, generator) * beard * (uniform(0, 1, generator) < 0.75)
    amount = torch.maximum(amount, uniform(0.2, 1.0, generator) * moustache * (uniform(0, 1, generator) < 0.7))
    return (1 - 0.8 * amount * ~lips).float()


def _draw_weights(names: tuple[str, ...], generator: torch.Generator) -> Tensor:
    """An expression (N,): asked-for ones, a few shapes more, an open jaw, closed lids, a glance."""
    table = dict.fromkeys(names, 0.0)

    def add(name: str, weight: float) -> None:
        if name in table:
            table[name] = max(table[name], weight)

    gestures = list(GESTURES.values())
    smile = uniform(0, 1, generator) < 0.45
    for _ in range(int(uniform(0, 2.6, generator))):
        strength = uniform(0.2, 1.0, generator)
        kind = gestures[0] if smile else gestures[int(uniform(0, len(gestures), generator))]
        for name, weight in kind.items():
            add(name, strength * weight)
    if smile and uniform(0, 1, generator) < 0.75:  # a smile with teeth
        up, down, wide = uniform(0.15, 0.7, generator), uniform(0.1, 0.7, generator), uniform(0.0, 0.6, generator)
        for side in ("Left", "Right"):
            add(f"mouthSmile{side}", uniform(0.4, 1.0, generator))
            add(f"mouthUpperUp{side}", up)
            add(f"mouthLowerDown{side}", down)
            add(f"mouthStretch{side}", wide)
    for _ in range(int(uniform(0, 5, generator))):
        add(names[int(uniform(0, len(names), generator))], uniform(0, 0.7, generator))
    if uniform(0, 1, generator) < 0.4:
        add("jawOpen", uniform(0.05, 0.9, generator) ** 1.5)
    if uniform(0, 1, generator) < 0.25:
        lids = uniform(0.2, 1.0, generator)
        add("eyeBlinkLeft", lids)
        add("eyeBlinkRight", lids)
    across, up = uniform(-0.7, 0.7, generator), uniform(-0.6, 0.5, generator)
    add("eyeLookInLeft" if across < 0 else "eyeLookOutLeft", abs(across))
    add("eyeLookOutRight" if across < 0 else "eyeLookInRight", abs(across))
    for side in ("Left", "Right"):
        add(f"eyeLook{'Up' if up > 0 else 'Down'}{side}", abs(up))
    return torch.tensor(list(table.values()))


def _draw_camera(settings: FaceImageSettings, generator: torch.Generator) -> Camera:
    yaw, pitch, roll = (torch.randn(3, generator=generator).clamp(-2.4, 2.4)).tolist()
    target = torch.tensor([0.0, -22.0, 55.0]) + 16 * torch.randn(3, generator=generator)
    span = uniform(240, 360, generator)
    view = 2 * math.degrees(math.atan(span / 2 / math.exp(uniform(math.log(400), math.log(2500), generator))))
    camera = look_at(target, settings.yaw * yaw, settings.pitch * pitch, span, _REFERENCE, _REFERENCE, view)
    angle = math.radians(settings.roll * roll)
    tilt = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]], dtype=torch.float64
    )
    return replace(camera, rotation=tilt @ camera.rotation, translation=tilt @ camera.translation)


def _render(person: _Person, settings: FaceImageSettings, generator: torch.Generator) -> FaceImage:
    rig = person.rig
    rest = widened(rig.vertices, person.width)
    moved = widened(rig(_draw_weights(rig.names, generator)[None])[0], person.width)
    camera = _draw_camera(settings, generator)
    scene = portrait(rest, moved, rig.neutral.faces, person.hairdo, generator)
    origins, ways = camera.rays()
    origins, ways = origins.reshape(-1, 3), ways.reshape(-1, 3)
    caster = RayCaster(scene.vertices, scene.faces)
    hits = caster.cast(origins, ways)
    seen = hits.triangle >= 0
    triangle, barycentric, ways = hits.triangle[seen], hits.barycentric[seen], ways[seen]
    points = origins[seen] + hits.distance[seen, None] * ways
    normals = vertex_normals(scene.vertices, scene.faces)
    normals = (normals[scene.faces[triangle]] * barycentric[..., None]).sum(1)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    normals = torch.where((normals * ways).sum(-1, keepdim=True) > 0, -normals, normals)
    albedo, gloss = _albedo(person, scene.part[triangle], triangle, barycentric, points, generator)
    light = _light(caster, camera, points, normals, ways, albedo, gloss, generator)
    face = scene.part[triangle] == 0
    # The exposure is set for the face, as a photographer's or a camera's would be, better or worse.
    light = light * uniform(0.18, 0.7, generator) / light[face].mean().clamp(min=1e-3)
    image = backdrop(_REFERENCE, _REFERENCE, generator).flatten()
    image[seen] = light.float()
    image = image.view(_REFERENCE, _REFERENCE)
    pixels = camera.project(moved.double())
    if person.glasses is not None:
        image = _glasses(image, camera, moved[head_annotations().landmarks].double(), person.glasses)
    curve = math.exp(uniform(-0.35, 0.35, generator))
    height = int(uniform(settings.smallest, settings.largest + 1, generator))
    stored = photographed(image.clamp(0, 1) ** curve, height, generator)
    zoom = height / _REFERENCE
    landmarks = (annotated_landmarks(pixels).float() + 0.5) * zoom - 0.5
    return FaceImage(stored, landmarks, box_around(landmarks), 0)


def _albedo(
    person: _Person, part: Tensor, triangle: Tensor, barycentric: Tensor, points: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """What a point throws back (R,), and how much of that it mirrors (R,)."""
    mesh, head = person.rig.neutral, part == 0
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    albedo, gloss = torch.full((len(part),), person.clothes), torch.zeros(len(part))
    strands = 0.8 + 0.35 * _strands(points, generator)
    albedo[part == 1] = (person.hair_grey * strands)[part == 1]
    albedo[part == 2] = person.teeth
    gloss[part == 2] = 0.3
    rows, weights = triangle[head], barycentric[head]
    uv = (mesh.uvs[mesh.uv_faces[rows]] * weights[..., None]).sum(1)
    regions = head_annotations().regions
    balls = (regions["eyeball_left"] | regions["eyeball_right"]).float()
    table = torch.stack([person.tint, person.hair, balls], dim=1)
    tint, hair, ball = (table[mesh.faces[rows]] * weights[..., None]).sum(1).unbind(1)
    skin = sample_texture(person.texture, uv)[:, 0]
    eye = torch.where(skin < 0.5, skin * person.eyes[0], skin * person.eyes[1])
    skin = torch.where(ball > 0.5, eye.clamp(0, 1), skin * tint)
    albedo[head] = torch.lerp(skin, person.hair_grey * strands[head], hair)
    gloss[head] = uniform(0.02, 0.3, generator) * (1 - hair) + 0.08 * hair
    return albedo, gloss


def _strands(points: Tensor, generator: torch.Generator) -> Tensor:
    """Fine streaks down the hair, about -1 to 1, (R,)."""
    way = torch.tensor([1.0, 0.12, 0.8]).double() * torch.rand(6, 3, generator=generator).double()
    phase = points @ way.T + 6.3 * torch.rand(6, generator=generator)
    return (phase.sin().sum(1) / 2.5).float()


def _light(
    caster: RayCaster,
    camera: Camera,
    points: Tensor,
    normals: Tensor,
    ways: Tensor,
    albedo: Tensor,
    gloss: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Light (R,) that comes back from points under lights from anywhere in front, above or beside."""
    right, down, forward = camera.rotation.double()
    starts = points + 0.3 * normals
    ambient = uniform(0.15, 1.0, generator)
    # Light from a sky or a window: more from one side than from the other.
    sky = torch.nn.functional.normalize(torch.randn(3, generator=generator).double() - 0.8 * down, dim=0)
    light = ambient * (1 + uniform(0, 0.8, generator) * (normals @ sky))
    light = light * openness(caster, starts, normals, generator, 5, 50.0)
    mirrored = torch.zeros_like(light)
    for number in range(int(uniform(0.6, 4, generator))):
        x, y = torch.randn(2, generator=generator).tolist()
        z = uniform(-0.3, 1.5, generator)
        toward = torch.nn.functional.normalize(x * right - (0.5 + y) * down - z * forward, dim=0)
        strength = uniform(0.1, 1.0, generator) * (1.0 if number == 0 else 0.5)
        soft = uniform(0.0, 0.5, generator)
        falls = ((normals @ toward + soft) / (1 + soft)).clamp(min=0)
        if uniform(0, 1, generator) < 0.6:
            dark = caster.occluded(starts, toward.expand_as(starts))
            falls = falls * torch.where(dark, uniform(0.0, 0.5, generator), 1.0)
        light = light + strength * falls
        half = torch.nn.functional.normalize(toward - ways, dim=-1)
        mirrored = mirrored + strength * (normals * half).sum(-1).clamp(min=0) ** uniform(8, 40, generator) * (
            falls > 0
        )
    return albedo * light + gloss * mirrored


def _glasses(image: Tensor, camera: Camera, marks: Tensor, form: tuple[float, float, float]) -> Tensor:
    """Frames of spectacles drawn over an image (H,W): half their width and height, millimetres, and their grey."""
    half_width, half_height, grey = form
    turn = torch.linspace(0, 2 * math.pi, 40).double()
    drawn = image.numpy().copy()
    curves = []
    for eye in (slice(36, 42), slice(42, 48)):
        middle = marks[eye].mean(0) + torch.tensor([0.0, -2.0, 14.0])
        ring = torch.stack([half_width * turn.cos(), half_height * turn.sin(), -2 * turn.cos() ** 2], -1)
        curves.append(middle + ring)
    bridge = torch.stack([curves[0][0], curves[1][20]])
    arms = [torch.stack([curve[row], ear]) for curve, row, ear in zip(curves, (20, 0), marks[[0, 16]], strict=True)]
    for curve in (*curves, bridge, *(arm + torch.tensor([0.0, 8.0, 0.0]) for arm in arms)):
        line = (camera.project(curve).numpy() * 16).round().astype("int32")
        cv2.polylines(drawn, [line], False, grey, 2, cv2.LINE_AA, 4)
    return torch.from_numpy(drawn)
