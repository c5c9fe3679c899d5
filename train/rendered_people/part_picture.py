"""A picture of someone whose every pixel is known: skin, hair, brows, eyes, lips, teeth, glasses, hand, cloth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.landmarks.images.ibug_68 import box_around
from torchface.landmarks.images.networks.part_network import PARTS
from torchface.rendering.raycast import Hits
from torchface.synthetic.head.identity import ramp

from .backdrops import uniform
from .face_picture import drawn_camera, drawn_weights
from .head_kind import EYEBALL, GUMS, SKIN, SOCKET, TEETH, HeadKind
from .lashes import with_lashes
from .people import Person, closed_lids, draw_person
from .picture_geometry import CLOTHES, CURTAIN, Surface, surface
from .rendered_person import render_person
from .scene_clutter import clutter, draw_hand, random_color
from .skin_paint import beard_share, brow_share
from .spectacles import with_glasses

SIZE = 160
"""Pixels a side of a picture."""
_BOX = 72.0  # pixels a side of the face's box in it
_ROW = {name: number for number, name in enumerate(PARTS)}
_BARE = 0.45  # share of people with a bare neck; where all had clothes to the chin, throats were hands to the network
_ALIKE = 0.12  # share of walls as dark or light as the hair before them


@dataclass(frozen=True, eq=False)
class PartPicture:
    """One picture."""

    image: Tensor  # uint8 (3,S,S)
    parts: Tensor  # of PARTS, uint8 (S,S)
    box: Tensor  # of the face, (4,) pixels


def draw_part_pictures(
    kinds: Sequence[HeadKind], shares: Sequence[float], first: int, count: int, seed: int, each: int, scenes: int
) -> list[PartPicture]:
    """Pictures by number, as :func:`draw_pictures`: of each person ``each`` are rendered, each is shown in ``scenes``
    surroundings.

    ``first`` and ``count`` are multiples of ``scenes``.
    """
    pictures: list[PartPicture] = []
    for number in range(first // scenes, (first + count) // scenes):  # each has a surface of its own
        person = torch.Generator().manual_seed(7_000_003 * seed + 2 * (number // each) + 1)
        someone = _dressed(draw_person(kinds, shares, person), person)
        generator = torch.Generator().manual_seed(7_000_003 * seed + 800_000_000_000 + number)
        shown = _photograph(someone, generator)
        pictures += [_staged(*shown, np.random.default_rng((seed, number, scene))) for scene in range(scenes)]
    return pictures


def _dressed(person: Person, generator: torch.Generator) -> Person:
    """Someone more likely to have glasses, a beard that hides skin, grey or white hair, and a bare neck."""
    looks = person.looks
    if uniform(0, 1, generator) < 0.12:
        looks = replace(looks, hair=torch.full((3,), uniform(0.4, 0.92, generator)))
    if uniform(0, 1, generator) < _BARE:
        looks = replace(looks, clothes=looks.skin)  # clothes are put on in the picture
    if uniform(0, 1, generator) < 0.25:
        lens = uniform(0.6, 0.97, generator) if uniform(0, 1, generator) < 0.4 else uniform(0, 0.12, generator)
        form = (uniform(18, 31, generator), uniform(12, 25, generator), uniform(0, 0.6, generator))
        looks = replace(looks, glasses=(*form, uniform(0.7, 3.2, generator), lens))
    if looks.beard and uniform(0, 1, generator) < 0.5:
        looks = replace(looks, beard=1.0, moustache=1.0)
    return replace(person, looks=looks)


def _photograph(person: Person, generator: torch.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours (S,S,4) in [0,1], parts (S,S), and the 68 landmarks (68,2)."""
    kind, looks = person.kind, person.looks
    posed = closed_lids(kind, person.head, drawn_weights(generator))
    scene = surface(kind, person.head, posed, looks, generator)
    camera = drawn_camera(kind, posed, generator, SIZE, _BOX)
    shown = render_person(person, scene, camera, generator)
    parts = parts_seen(person, scene, shown.hits).view(SIZE, SIZE)
    marks = posed[kind.landmarks].double()
    dark = looks.lashes or looks.liner > 0.3
    image = with_lashes(shown.image, shown.distance, camera, marks, (0.3 * looks.hair).clamp(max=0.14), dark, generator)
    if looks.glasses is not None:
        state = generator.get_state()
        image, _ = with_glasses(image, camera, marks, looks.glasses, generator)
        # On nothing frames alone are drawn; on white a lens is what darkens it.
        again = [torch.Generator(), torch.Generator()]
        for copy in again:
            copy.set_state(state)
        frame = with_glasses(torch.zeros_like(image), camera, marks, looks.glasses, again[0])[0][..., 3]
        lens = with_glasses(torch.ones_like(image), camera, marks, looks.glasses, again[1])[0][..., 1]
        parts[(frame > 0.4) | (lens < 0.5)] = _ROW["glasses"]
    pixels = camera.project(marks).numpy()
    if looks.clothes is looks.skin:
        _put_on_clothes(image, parts, pixels, looks.skin, generator)
    return image.numpy(), parts.numpy(), pixels


def _put_on_clothes(image: Tensor, parts: Tensor, marks: np.ndarray, skin: Tensor, generator: torch.Generator) -> None:
    """Clothes over the lower part of a bare bust, with a neckline: round, pointed, or from shoulder to shoulder."""
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    bust = (parts == _ROW["cloth"]) & (row > marks[8, 1])  # a cap is not
    side = float(marks[16, 0] - marks[0, 0])
    aside = ((column - float(marks[8, 0])).abs() / max(1.0, side * uniform(0.4, 1.6, generator))).clamp(max=1)
    depth = side * uniform(0.15, 1.0, generator) * (1 - aside ** uniform(0.6, 3, generator))
    bare = bust & (row < marks[8, 1] + side * uniform(0.1, 0.45, generator) + depth)
    parts[bare] = _ROW["skin"]
    dressed = bust & ~bare
    cloth = torch.rand(3, generator=generator) * uniform(0.1, 1, generator)
    image[..., :3][dressed] = (image[..., :3][dressed] * cloth / skin.clamp(min=0.1)).clamp(0, 1)


def parts_seen(person: Person, scene: Surface, hits: Hits) -> Tensor:
    """Which of :data:`PARTS` rays meet, glasses aside, uint8 (R,)."""
    kind, looks = person.kind, person.looks
    seen = (hits.triangle >= 0).nonzero()[:, 0]
    triangle, barycentric = hits.triangle[seen], hits.barycentric[seen].float()
    material, corners = scene.material[triangle], scene.faces[triangle]
    hair = _ROW["hair"] if looks.hat is None else _ROW["cloth"]
    part = torch.full_like(material, _ROW["skin"])
    part[material == CURTAIN], part[material == CLOTHES] = hair, _ROW["cloth"]
    part[material == EYEBALL] = _ROW["eyes"]
    part[(material == TEETH) | (material == GUMS) | (material == SOCKET)] = _ROW["teeth"]
    skin = ((material == SKIN) & (corners < len(kind.canonical)).all(1)).nonzero()[:, 0]
    table = torch.cat([kind.canonical.float(), kind.marks, scene.hair[:, None]], dim=1)
    values = (table[corners[skin]] * barycentric[skin, :, None]).sum(1)
    place, lips, mouth, socket = values[:, :3], values[:, 3], values[:, 4], values[:, 6]
    of_skin = part[skin]
    of_skin[(beard_share(place, looks) > 0.45) & (lips < 0.25)] = _ROW["hair"]
    of_skin[brow_share(place, looks, kind.brow_lift) > 0.35] = _ROW["brows"]
    of_skin[ramp(values[:, 11], 0.05, 0.5) > 0.5] = hair
    of_skin[lips > 0.5] = _ROW["lips"]
    of_skin[mouth > 0.5] = _ROW["teeth"]
    of_skin[socket > 0.5] = _ROW["eyes"]
    part[skin] = of_skin
    whole = torch.zeros(len(hits.triangle), dtype=torch.uint8)
    whole[seen] = part.byte()
    return whole


def _staged(person: np.ndarray, parts: np.ndarray, marks: np.ndarray, rng: np.random.Generator) -> PartPicture:
    """Someone before clutter, with more hair behind, strands and hands and a mask before the face, at times."""
    image, parts = clutter(SIZE, SIZE, rng).astype(np.float32), parts.copy()
    colors, alpha = person[..., :3] * 255, person[..., 3:]
    is_hair, is_skin = parts == _ROW["hair"], parts == _ROW["skin"]
    hair = colors[is_hair].mean(0) if is_hair.sum() > 30 else np.array(random_color(rng, 0)) * 0.5
    skin = np.median(colors[is_skin], 0) if is_skin.any() else np.array(random_color(rng, 1))
    box = box_around(torch.from_numpy(marks).float())
    face, side = (box[:2] + box[2:] / 2).numpy(), float(box[2])
    if rng.random() < _ALIKE:
        image = 0.25 * image + 0.75 * (hair * rng.uniform(0.6, 1.4) + rng.normal(0, 8, 3)).astype(np.float32)
    behind = np.zeros((SIZE, SIZE), np.uint8)
    if rng.random() < 0.35:
        _more_hair(behind, face, side, rng)
        _paint(image, behind, hair, rng)
    image = image * (1 - alpha) + colors * alpha
    parts[(behind > 127) & (alpha[..., 0] < 0.5)] = _ROW["hair"]
    if rng.random() < 0.3:
        glasses = parts == _ROW["glasses"]
        image[glasses] = 0.6 * image[glasses] + 0.4 * np.array(random_color(rng, 0))
    for share, name, draw in ((0.06, "cloth", _mask), (0.4, "hair", _strands), (0.08, "background", _thing)):
        if rng.random() < share:
            cover = np.zeros((SIZE, SIZE), np.uint8)
            draw(cover, face, side, marks, rng)
            color = hair * rng.uniform(0.7, 1.2) if name == "hair" else np.array(random_color(rng, 0))
            _paint(image, cover, color, rng)
            parts[cover > 127] = _ROW[name]
    if rng.random() < 0.25:
        _hand(image, parts, face, side, skin, rng)
    stored = torch.from_numpy(image.clip(0, 255).round().astype(np.uint8)).permute(2, 0, 1).contiguous()
    return PartPicture(stored, torch.from_numpy(parts), box)


def _paint(image: np.ndarray, cover: np.ndarray, color: np.ndarray, rng: np.random.Generator) -> None:
    """A covered part (S,S) of an image in one colour with streaks and spots."""
    coarse = rng.normal(0, 1, (int(rng.integers(3, 30)), int(rng.integers(10, 80)), 1)).astype(np.float32)
    streaks = cv2.resize(coarse, (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)[..., None]
    share = cover[..., None] / np.float32(255)
    image[:] = image * (1 - share) + share * color * (1 + rng.uniform(0.05, 0.3) * streaks).clip(0.3, 2)


def _more_hair(cover: np.ndarray, face: np.ndarray, side: float, rng: np.random.Generator) -> None:
    """A mane behind a head: round, or long down to the shoulders, with an uneven edge."""
    top = face - (0, side * rng.uniform(0.05, 0.4))
    wide, high = side * rng.uniform(0.5, 0.95), side * rng.uniform(0.6, 1.0)
    long = rng.random() < 0.5
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    edge = 1 + rng.uniform(0.02, 0.1) * np.sin(angle * rng.integers(3, 12) + 6 * rng.random())
    edge = edge + 0.03 * rng.normal(0, 1, 60)
    down = np.where(np.sin(angle) > 0, rng.uniform(1.0, 2.0) if long else 1.0, 1.0)
    outline = np.stack([wide * np.cos(angle) * edge, high * np.sin(angle) * edge * down], 1) + top
    cv2.fillPoly(cover, [(8 * outline).astype(np.int32)], 255, cv2.LINE_AA, 3)


def _strands(cover: np.ndarray, face: np.ndarray, side: float, marks: np.ndarray, rng: np.random.Generator) -> None:
    """Locks that fall over the forehead or down the cheeks."""
    for _ in range(int(rng.integers(1, 5))):
        start = face + side * np.array([rng.uniform(-0.55, 0.55), rng.uniform(-0.85, -0.5)])
        lean, bend, length = rng.uniform(-0.6, 0.6), rng.uniform(-0.5, 0.5), side * rng.uniform(0.25, 1.1)
        t = np.linspace(0, 1, 10)
        for _ in range(int(rng.integers(2, 22))):
            own = start + rng.normal(0, 0.06 * side, 2)
            reach = length * rng.uniform(0.6, 1.1)
            x = own[0] + reach * ((lean + rng.normal(0, 0.05)) * t + bend * t * t)
            curve = np.stack([x, own[1] + reach * t], 1)
            cv2.polylines(cover, [(8 * curve).astype(np.int32)], False, 255, int(rng.integers(1, 4)), cv2.LINE_AA, 3)


def _mask(cover: np.ndarray, face: np.ndarray, side: float, marks: np.ndarray, rng: np.random.Generator) -> None:
    """Cloth over mouth and nose, as far as the ears."""
    outline = np.concatenate([marks[2:15] + rng.normal(0, 0.01 * side, 2), marks[[int(rng.integers(28, 31))]]])
    cv2.fillPoly(cover, [(8 * outline).astype(np.int32)], 255, cv2.LINE_AA, 3)


def _thing(cover: np.ndarray, face: np.ndarray, side: float, marks: np.ndarray, rng: np.random.Generator) -> None:
    """A cup, a telephone, a microphone."""
    corners = (
        tuple(face + side * rng.uniform(-0.7, 0.7, 2)),
        tuple(side * rng.uniform(0.15, 0.6, 2)),
        180 * rng.random(),
    )
    if rng.random() < 0.5:
        cv2.ellipse(cover, corners, 255, -1, cv2.LINE_AA)
    else:
        cv2.fillPoly(cover, [cv2.boxPoints(corners).astype(np.int32)], 255, cv2.LINE_AA)


def _hand(
    image: np.ndarray, parts: np.ndarray, face: np.ndarray, side: float, skin: np.ndarray, rng: np.random.Generator
) -> None:
    """A hand before the face or beside it, most often of the person's own colour."""
    drawn = np.zeros((SIZE, SIZE, 3), np.uint8)
    way, size = rng.uniform(-1, 1, 2) * (0.75, 0.6) + (0, 0.25), side * rng.uniform(0.5, 1.0)
    draw_hand(drawn, face + side * way, size, rng, -np.pi / 2 + rng.normal(0, 0.7))
    cover = drawn.max(2) > 12
    if not cover.any():
        return
    own = drawn.astype(np.float32)
    if rng.random() < 0.7:
        own = own * (skin / own[cover].mean(0).clip(1)) * rng.uniform(0.7, 1.15)
    depth = cv2.distanceTransform(cover.astype(np.uint8), cv2.DIST_L2, 3)
    own = own * np.clip(0.6 + 0.4 * depth / max(2.0, 0.08 * size), 0, 1)[..., None]
    image[cover], parts[cover] = own[cover], _ROW["hand"]
