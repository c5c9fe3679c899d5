"""A colour picture of someone's eyes, cut out of its background, with lids, irises and which of them can be seen."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.meshes.operators import vertex_normals
from torchface.landmarks.images.ibug_68 import as_annotated
from torchface.shape_names import ARKIT
from torchface.synthetic.head.signed_distance import EYE_CENTRE

from .backdrops import uniform
from .expressions import draw_expression
from .head_kind import EYEBALL, SKIN, DrawnHead, HeadKind
from .lashes import with_lashes
from .looks import Looks
from .people import Person, closed_lids, draw_person
from .picture_geometry import CURTAIN, Surface
from .portrait_geometry import curtain, hair_share_at, lumps
from .rendered_person import render_person, visible_points
from .spectacles import with_glasses
from .turned_eyes import gaze_toward, gaze_weights, iris_centres, with_turned_eyes

EYES_WIDTH, EYES_HEIGHT = 160, 64
"""Pixels of a picture of both eyes."""
_SPAN = 138.0  # millimetres that its width shows of a face seen from the front
_BEHIND = 5.0  # millimetres that a landmark may lie behind what is seen
_NEAR = ((-85.0, -40.0, 5.0), (85.0, 55.0, 200.0))  # corners of the part of the sculpture that is rendered
_FRAME = 2.1  # how much larger frames of spectacles are in pixels than in a picture of the whole face
_SIDES = ("Right", "Left")


@dataclass(frozen=True, eq=False)
class EyePicture:
    """One picture; the person's right eye comes first."""

    rgba: Tensor  # uint8 (4,H,W); the fourth channel is 255 on the person, 0 on what is behind
    landmarks: Tensor  # iBUG's 68 as an annotator sees them, (68,2) pixels; most lie outside
    visible: Tensor  # which of landmarks 36 to 47 nothing hides, (12,) bool
    iris: Tensor  # centres of the irises, (2,2) pixels
    openness: Tensor  # the lids' distance on the head over that of the eye's corners, (2,)
    bare: Tensor  # how much of each eyeball is seen between the lids, (2,) square millimetres
    gaze: Tensor  # of each eye, (2,2) radians: to the person's left, up
    person: int


def draw_eye_pictures(
    kinds: Sequence[HeadKind], shares: Sequence[float], first: int, count: int, seed: int, each: int = 5
) -> list[EyePicture]:
    """Pictures by number, each of a person's eyes with lids, a gaze, a pose and lights drawn for it, ``each`` of one
    person.

    A picture depends on its number, from ``first`` on, and the seed alone; ``shares`` say how often a kind is drawn.
    """
    parts = [_eye_kind(id(kind), kind) for kind in kinds]
    pictures: list[EyePicture] = []
    someone: Person | None = None
    for number in range(first, first + count):  # each has a surface of its own
        person = number // each
        if someone is None or number % each == 0:
            someone = draw_person(parts, shares, torch.Generator().manual_seed(7_000_003 * seed + 2 * person + 1))
        generator = torch.Generator().manual_seed(7_000_003 * seed + 800_000_000_000 + number)
        pictures.append(replace(_photograph(someone, generator), person=person))
    return pictures


def _photograph(person: Person, generator: torch.Generator) -> EyePicture:
    kind, looks, rest = person.kind, person.looks, person.head.rest
    camera = _camera(rest[kind.landmarks].double(), generator)
    gaze = _draw_gaze(kind, rest, camera, generator)
    posed = closed_lids(kind, person.head, _draw_weights(gaze, generator))
    posed = with_turned_eyes(kind, rest, posed, gaze)
    pixels = camera.project(posed[kind.landmarks].double())
    landmarks = as_annotated(pixels).float()
    shown = render_person(person, _eye_surface(kind, rest, posed, looks, generator), camera, generator)
    marks = posed[kind.landmarks].double()
    tone = (0.3 * looks.hair).clamp(max=0.14)
    image = with_lashes(shown.image, shown.distance, camera, marks, tone, looks.lashes or looks.liner > 0.3, generator)
    visible = visible_points(shown.distance, camera, marks[36:48], landmarks[36:48], _BEHIND)
    if looks.glasses is not None:
        half_width, half_height, grey, thickness, lens = looks.glasses
        form = (half_width, half_height, grey, _FRAME * thickness, lens)
        image, hidden = with_glasses(image, camera, marks, form, generator)
        visible &= ~hidden[36:48]
    stored = (255 * image.clamp(0, 1)).round().to(torch.uint8).permute(2, 0, 1).contiguous()
    iris = camera.project(iris_centres(kind, posed).double()).float()
    gap, width = _gaps(as_annotated(marks.float()))
    bare = _bare_area(shown.material, camera, marks, landmarks)
    return EyePicture(stored, landmarks, visible, iris, gap / width, bare, gaze, 0)


def _bare_area(material: Tensor, camera: Camera, marks: Tensor, landmarks: Tensor) -> Tensor:
    """How much of each eyeball a camera sees, (2,) square millimetres."""
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    place = torch.stack([columns, rows], dim=-1)[material == EYEBALL].float()
    middles = torch.stack([landmarks[36:42].mean(0), landmarks[42:48].mean(0)])
    nearest = (place[:, None] - middles).norm(dim=-1).argmin(1)
    depth = torch.stack([(marks[rows].mean(0) - camera.centre).norm() for rows in (slice(36, 42), slice(42, 48))])
    pixel = (depth / camera.intrinsics[0, 0]).square()
    return (torch.bincount(nearest, minlength=2) * pixel).float()


def _gaps(marks: Tensor) -> tuple[Tensor, Tensor]:
    """Distances of lids and of eyes' corners of landmarks (68,3), (2,) each; lids that overlap are 0 apart."""
    gaps, widths = [], []
    for start in (36, 42):
        upper, lower = marks[[start + 1, start + 2]], marks[[start + 5, start + 4]]
        apart = (upper - lower).norm(dim=1) * ((upper - lower)[:, 1] > 0)
        gaps.append(apart.mean())
        widths.append((marks[start] - marks[start + 3]).norm())
    return torch.stack(gaps), torch.stack(widths)


def _draw_gaze(kind: HeadKind, rest: Tensor, camera: Camera, generator: torch.Generator) -> Tensor:
    """Where the eyes look, (2,2) radians: into the camera, near it, or anywhere."""
    limit = torch.tensor([math.radians(36), math.radians(28)])
    if uniform(0, 1, generator) < 0.4:
        gaze = gaze_toward(kind, rest, camera.centre)
        gaze = gaze + math.radians(5) * torch.randn(2, generator=generator)
    else:
        across = torch.randn((), generator=generator) * math.radians(17)
        up = math.radians(uniform(-27, 22, generator))
        near = math.radians(uniform(0, 6, generator))  # both turn inward to what is near
        gaze = torch.stack(
            [torch.stack([across + near, torch.tensor(up)]), torch.stack([across - near, torch.tensor(up)])]
        )
    return (gaze + math.radians(1) * torch.randn(2, 2, generator=generator)).clamp(-limit, limit)


def _draw_weights(gaze: Tensor, generator: torch.Generator) -> Tensor:
    """ARKit's weights (52,): a face's expression with lids that follow the gaze and open or close each for itself."""

    def between(low: float, high: float) -> float:
        return uniform(low, high, generator)

    weights = draw_expression(generator)
    for name in ("eyeBlink", "eyeSquint", "eyeWide", *(f"eyeLook{way}" for way in ("In", "Out", "Up", "Down"))):
        weights[[ARKIT.index(f"{name}{side}") for side in _SIDES]] = 0.0
    weights = torch.maximum(weights, gaze_weights(gaze))

    def put(name: str, amounts: tuple[float, float]) -> None:
        for side, amount in zip(_SIDES, amounts, strict=True):
            weights[ARKIT.index(f"{name}{side}")] = min(1.0, max(0.0, amount))

    kind, level = between(0, 1), between(0, 1)
    if kind < 0.2:
        put("eyeBlink", (1.0, 1.0))
    elif kind < 0.5:
        put("eyeBlink", (level + between(-0.06, 0.06), level + between(-0.06, 0.06)))
    elif kind < 0.6:
        other = between(0, 0.4)
        put("eyeBlink", (1 - 0.4 * level, other) if between(0, 1) < 0.5 else (other, 1 - 0.4 * level))
    elif kind < 0.72:
        put("eyeBlink", (0.3 * level, 0.3 * level))
    elif kind < 0.85:
        put("eyeWide", (level, level + between(-0.2, 0.2)))
    if between(0, 1) < (0.25 if kind < 0.72 else 0.1):
        squint = between(0.1, 1)
        put("eyeSquint", (squint, squint + between(-0.3, 0.3)))
    return weights


def _camera(marks: Tensor, generator: torch.Generator) -> Camera:
    """A camera that frames both eyes of a head with landmarks (68,3)."""
    yaw = (
        float(torch.randn((), generator=generator)) * 20
        if uniform(0, 1, generator) < 0.65
        else uniform(-58, 58, generator)
    )
    yaw = max(-58.0, min(58.0, yaw))
    pitch = 5 + 12 * float(torch.randn((), generator=generator).clamp(-2.6, 2.6))
    span = _SPAN * uniform(0.95, 1.08, generator) * EYES_HEIGHT / EYES_WIDTH
    away = math.exp(uniform(math.log(300), math.log(2500), generator))
    target = (marks[36:42].mean(0) + marks[42:48].mean(0)) / 2
    view = 2 * math.degrees(math.atan(0.5 * span / away))
    return look_at(target, yaw, pitch, span, EYES_WIDTH, EYES_HEIGHT, view)


def _eye_surface(kind: HeadKind, rest: Tensor, posed: Tensor, looks: Looks, generator: torch.Generator) -> Surface:
    """A posed head (V,3) with hair that hangs beside it."""
    posed = posed.double()
    hair = hair_share_at(kind.canonical, kind.marks[:, 7] > 0.5, looks.hairdo.hairline) * kind.outer
    lift = looks.hairdo.thickness * hair * (1.0 + 0.4 * lumps(kind.canonical, generator)).clamp(min=0.1)
    lifted = posed + lift[:, None] * vertex_normals(posed, kind.faces)
    hair = (hair * (looks.hairdo.thickness > 0)).float()
    if looks.hairdo.curtain <= 0:
        return Surface(lifted, kind.faces, kind.material, hair)
    vertices, strands = curtain(rest.double(), looks.hairdo, generator)
    return Surface(
        torch.cat([lifted, vertices]),
        torch.cat([kind.faces, strands + len(lifted)]),
        torch.cat([kind.material, torch.full((len(strands),), CURTAIN)]),
        hair,
    )


@lru_cache(maxsize=4)
def _eye_kind(_: int, kind: HeadKind) -> HeadKind:
    """The part of heads that a picture of eyes can show, with all landmarks."""
    middle = kind.canonical[kind.faces].mean(1)
    low, high = middle.new_tensor(_NEAR)
    near = ((middle > low) & (middle < high)).all(1) & ((kind.material == SKIN) | (kind.material == EYEBALL))
    centre = torch.tensor(EYE_CENTRE) * torch.where(middle[:, :1] < 0, -1.0, 1.0) ** torch.tensor([1.0, 0.0, 0.0])
    near &= (kind.material != EYEBALL) | ((middle - centre)[:, 2] > -1.0)
    kept = torch.cat([kind.faces[near].flatten(), kind.landmarks]).unique()
    place = torch.full((len(kind.canonical),), -1)
    place[kept] = torch.arange(len(kept))

    def draw(generator: torch.Generator) -> DrawnHead:
        whole = kind.draw(generator)
        return DrawnHead(whole.rest[kept], whole.deltas[:, kept])

    return replace(
        kind, faces=place[kind.faces[near]], material=kind.material[near], landmarks=place[kind.landmarks],
        canonical=kind.canonical[kept], marks=kind.marks[kept], outer=kind.outer[kept], draw=draw,
    )  # fmt: skip
