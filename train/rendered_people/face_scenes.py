"""Whole pictures with people in them, put together from cut-outs: what a face detector learns from."""

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Protocol

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.landmarks.images.boxes.box_training import LabelledPicture
from torchface.landmarks.images.ibug_68 import turned_box

from .scene_clutter import clutter, draw_hand, random_color

_HULL = [*range(17), *range(26, 16, -1)]  # the jaw's contour, and back along the brows
# Shares of a face that are seen: from the first on it is one, under the second it is none.
_FOUND, _DOUBTFUL = 0.55, 0.1
_SCENES, _VIEWS = 16, 8  # what is drawn once is shown so often: drawing takes longer than learning
_WHOLE = 0.75  # of a face's box that must lie in the picture for it to count as one


class ScenePeople(Protocol):
    """People without a background, in memory or in files."""

    @property
    def landmarks(self) -> Tensor:
        """iBUG's 68 of each, (N,68,2) pixels."""
        ...

    @property
    def faces(self) -> np.ndarray:
        """Centre, side and roll angle of each face, (N,4)."""
        ...

    def __len__(self) -> int: ...

    def __hash__(self) -> int: ...

    def person(self, number: int) -> np.ndarray:
        """One picture, (S,S,4), black where nobody is."""
        ...


def upright_faces(landmarks: Tensor) -> np.ndarray:
    """Centre, side and roll angle of the faces of landmarks (N,68,2), (N,4)."""
    boxes, tilts = turned_box(landmarks)
    return torch.cat([boxes[:, :2] + boxes[:, 2:] / 2, boxes[:, 2:3], tilts[:, None]], 1).numpy()


def cut_out(rgba: Tensor) -> np.ndarray:
    """A picture (4,S,S) as (S,S,4), black where nobody is."""
    picture = rgba.permute(1, 2, 0).contiguous().numpy()
    picture[picture[..., 3] == 0] = 0
    return picture


@dataclass(frozen=True)
class SceneSettings:
    """What is in a scene.

    Args:
        size: pixels a side.
        people: at most.
        smallest, largest: side of a face's box, pixels; the larger the rarer.
        turned: share of people at any roll angle; the others are near upright.
        broken: share of people whose face is shuffled, covered with skin or with hair: they are none.
        huge: share of people who are up to seven times as large as the largest: they are none, though their eyes and
            mouths are seen. A detector finds them in a smaller copy of the picture.
    """

    size: int = 96
    people: int = 4
    smallest: float = 12.0
    largest: float = 44.0
    turned: float = 0.75
    broken: float = 0.15
    huge: float = 0.15

    def __post_init__(self) -> None:
        if not (self.size >= 64 and self.people >= 0 and 4 <= self.smallest < self.largest):
            raise ValueRangeError(
                f"scenes: found size {self.size}, people {self.people}, faces of {self.smallest} to {self.largest}; "
                "expected 64 pixels or more, no negative number, and sizes from 4 that rise"
            )


def face_scene(
    people: ScenePeople, number: int, settings: SceneSettings | None = None, seed: int = 0
) -> LabelledPicture:
    """Draws a scene; of 128 numbers in a row each eight show one, mirrored or not, in another light.

    People stand before each other, the larger in front; they are mirrored, turned, cut by the border, hidden by hands,
    bars and things. Then the picture is taken: light, colour, blur, noise, compression.
    """
    settings = settings or SceneSettings()
    block, place = divmod(number, _SCENES * _VIEWS)
    image, faces, uncertain = _staged(people, block * _SCENES + place % _SCENES, settings, seed)
    if place // _SCENES % 2:
        image = np.ascontiguousarray(image[:, ::-1])
        faces = faces * torch.tensor([-1.0, 1, 1, -1]) + torch.tensor([settings.size - 1.0, 0, 0, 0])
    stored = _photographed(image, np.random.default_rng((seed, number, 1)))
    return LabelledPicture(torch.from_numpy(stored).permute(2, 0, 1).contiguous(), faces, uncertain)


def empty_scene(piece: np.ndarray, rng: np.random.Generator) -> LabelledPicture:
    """A square (S,S,3) without a face as a picture: turned by quarters, mirrored or not, in another light."""
    image = np.rot90(piece[:, :: int(rng.choice([-1, 1]))], int(rng.integers(4)))
    stored = _photographed(np.ascontiguousarray(image), rng)
    return LabelledPicture(
        torch.from_numpy(stored).permute(2, 0, 1).contiguous(), torch.zeros(0, 4), torch.zeros(0, dtype=torch.bool)
    )


@lru_cache(maxsize=2 * _SCENES)  # each is shown again soon
def _staged(people: ScenePeople, number: int, settings: SceneSettings, seed: int) -> tuple[np.ndarray, Tensor, Tensor]:
    """A scene before it is taken (S,S,3), its faces (F,4), and which are uncertain (F,)."""
    rng = np.random.default_rng((seed, number, 0))
    size = settings.size
    image = clutter(size, size, rng)
    owner = np.full((size, size), -1, dtype=np.int16)
    count = int(rng.choice(settings.people + 1, p=_crowd(settings.people)))
    sides = np.exp(rng.uniform(np.log(settings.smallest), np.log(settings.largest), count))
    faces: list[np.ndarray] = []
    hulls: list[np.ndarray] = []
    sides = np.where(rng.random(count) < settings.huge, settings.largest * rng.uniform(1.6, 7, count), sides)
    for side in np.sort(sides):  # in front of those before
        face, hull = _stand(image, owner, people, float(side), len(faces), settings, rng)
        if face is not None and side <= settings.largest:
            faces.append(face)
            hulls.append(hull)
    for hull in hulls:
        if rng.random() < 0.22:
            _occlude(image, owner, hull, rng)
    seen = np.array([_share_seen(owner, hull, number) for number, hull in enumerate(hulls)])
    faces_there = torch.from_numpy(np.array(faces, dtype=np.float32).reshape(-1, 4))
    inside = np.array([_share_inside(face, size) for face in faces])
    kept = torch.from_numpy(seen >= _DOUBTFUL) if faces else torch.zeros(0, dtype=torch.bool)
    uncertain = (seen < _FOUND) | (inside < _WHOLE) | (faces_there[:, 2].numpy() < settings.smallest * 1.15)
    return image, faces_there[kept], torch.from_numpy(uncertain.astype(bool))[kept]


def _crowd(people: int) -> np.ndarray:
    """How likely each number of people is: one or two most."""
    likely = np.array([0.12, 0.34, 0.24, 0.14, 0.09, 0.07])
    likely = np.concatenate([likely, np.full(max(0, people - 5), 0.05)])[: people + 1]
    return likely / likely.sum()


def _stand(
    image: np.ndarray,
    owner: np.ndarray,
    people: ScenePeople,
    side: float,
    number: int,
    settings: SceneSettings,
    rng: np.random.Generator,
) -> tuple[np.ndarray | None, np.ndarray]:
    """Paints someone into the image and their number into ``owner`` (S,S); the face (4,), None if it was broken."""
    chosen = int(rng.integers(len(people)))
    picture, marks = people.person(chosen), people.landmarks[chosen].numpy()
    whole = picture.shape[0]
    broken = rng.random() < settings.broken
    if broken:
        picture = _broken(picture, marks, rng)
    x, y, width, own = people.faces[chosen].tolist()
    hull = marks[_HULL]
    if rng.random() < 0.5:
        picture = np.ascontiguousarray(picture[:, ::-1])
        x, own, hull = whole - 1 - x, -own, hull * (-1, 1) + (whole - 1, 0)
    turn = rng.uniform(-np.pi, np.pi) if rng.random() < settings.turned else rng.normal(0, 0.15)
    scale, middle = side / width, np.array([x, y])
    if scale < 0.7:  # as a camera gathers light, not by picking pixels
        small = max(8, round(whole * scale))
        picture = cv2.resize(picture, (small, small), interpolation=cv2.INTER_AREA)
        middle, scale = _scaled(middle, whole, small), scale * whole / small
    beyond = rng.choice([-0.35, 0.3], p=[0.75, 0.25]) * side  # most lie inside, the others may be cut
    low = min(-beyond, 0.5 * settings.size)
    place = rng.uniform(low, settings.size - low, 2)
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    matrix = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0]])
    matrix[:, 2] = place - matrix[:, :2] @ middle
    if rng.random() < 0.9:
        _dress(image, owner, picture, matrix, rng)
    light = (rng.uniform(0.6, 1.3) * (1 + rng.normal(0, 0.05, 3))).astype(np.float32)
    _paint(image, owner, picture, matrix, light, -2 if broken else number)
    hull = _scaled(hull, whole, picture.shape[0]) @ matrix[:, :2].T + matrix[:, 2]
    turned = (own + turn + np.pi) % (2 * np.pi) - np.pi
    return (None if broken else np.array([*place, side, turned])), hull


def _paint(
    image: np.ndarray, owner: np.ndarray, picture: np.ndarray, matrix: np.ndarray, light: np.ndarray, number: int
) -> None:
    """Lays a picture, black where nobody is, over an image, moved by a matrix (2,3), in another light."""
    side = picture.shape[0] - 1
    corners = np.array([[0, 0], [side, 0], [side, side], [0, side]]) @ matrix[:, :2].T + matrix[:, 2]
    limits = np.array(image.shape[1::-1])
    low = np.floor(corners.min(0)).astype(int).clip(0, limits)
    high = np.ceil(corners.max(0) + 1).astype(int).clip(0, limits)
    if (high <= low).any():
        return
    moved = matrix.copy()
    moved[:, 2] -= low
    layers = cv2.warpAffine(picture, moved, tuple((high - low).tolist()), flags=cv2.INTER_LINEAR)
    place = np.s_[low[1] : high[1], low[0] : high[0]]
    cover = layers[..., 3:]
    behind = image[place] * ((255 - cover) * np.float32(1 / 255))
    image[place] = np.minimum(behind + np.minimum(layers[..., :3] * light, cover), 255).astype(np.uint8)
    owner[place][cover[..., 0] > 127] = number


def _scaled(points: np.ndarray, before: int, after: int) -> np.ndarray:
    """Pixels of a picture that was resized from one side to another."""
    return (points + 0.5) * (after / before) - 0.5


def _dress(
    image: np.ndarray, owner: np.ndarray, picture: np.ndarray, matrix: np.ndarray, rng: np.random.Generator
) -> None:
    """A trunk under a cut-out: it ends at its picture's lower edge, which no person does."""
    side = picture.shape[0]
    columns = np.flatnonzero(picture[-1, :, 3] > 127)
    if not len(columns):
        return
    low, high, wide = columns[0], columns[-1], rng.uniform(0.0, 0.5) * side
    outline = np.array([
        [low, side - 3], [low - 0.6 * wide, side + 0.25 * wide], [low - wide, side + 2.0 * side],
        [high + wide, side + 2.0 * side], [high + 0.6 * wide, side + 0.25 * wide], [high, side - 3],
    ])  # fmt: skip
    corners = (outline @ matrix[:, :2].T + matrix[:, 2]).round().clip(-20000, 20000).astype(np.int32)
    if rng.random() < 0.6:
        color = picture[-4:-1, low : high + 1, :3].reshape(-1, 3).mean(0).tolist()
    else:
        color = random_color(rng, 0.1)
    cv2.fillPoly(image, [corners], color, cv2.LINE_AA)
    cv2.fillPoly(owner, [corners], -1)  # type: ignore[call-overload]


def _broken(picture: np.ndarray, marks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Someone whose face is none any more: its pieces shuffled, skin alone, or hair, as from behind."""
    side = picture.shape[0]
    hull = marks[_HULL].copy()
    hull[17:] -= (marks[8] - marks[27]) * 0.35  # the forehead too
    if rng.random() < 0.35:
        low, high = hull.min(0).astype(int).clip(0, side - 9), hull.max(0).astype(int).clip(8, side)
        count = int(rng.integers(3, 6))
        step = np.maximum((high - low) // count, 1)
        before = picture.copy()
        for target, source in enumerate(rng.permutation(count * count)):
            (ty, tx), (sy, sx) = divmod(target, count), divmod(int(source), count)
            there = low + step * (tx, ty)
            here = low + step * (sx, sy)
            picture[there[1] : there[1] + step[1], there[0] : there[0] + step[0]] = before[
                here[1] : here[1] + step[1], here[0] : here[0] + step[0]
            ]
        return picture
    mask: np.ndarray = np.zeros((side, side), dtype=np.float32)
    cv2.fillConvexPoly(mask, cv2.convexHull(hull.round().astype(np.int32)), 1.0)
    mask = cv2.GaussianBlur(cv2.dilate(mask, np.ones((5, 5))), (0, 0), 2)[..., None]
    x, y = marks[27].astype(int)
    if rng.random() < 0.5:  # the cheeks' colour
        x, y = ((marks[31] + marks[2]) / 2).astype(int)
    else:  # the hair's, above
        y = max(2, int(y - 1.0 * (marks[8, 1] - marks[27, 1])))
    patch = picture[max(0, y - 4) : y + 5, max(0, x - 4) : x + 5, :3].reshape(-1, 3)
    color = patch.mean(0) if len(patch) else np.array(random_color(rng, 0.5))
    streaks = cv2.resize(rng.normal(0, 14, (12, 24, 1)).astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC)
    filled = color + streaks[..., None] * rng.uniform(0.1, 1)
    picture[..., :3] = np.clip(picture[..., :3] * (1 - mask) + filled * mask, 0, 255).astype(np.uint8)
    return picture


def _occlude(image: np.ndarray, owner: np.ndarray, hull: np.ndarray, rng: np.random.Generator) -> None:
    """Something in front of a face (F,2): a hand, a bar, a thing, a microphone."""
    low, high = hull.min(0), hull.max(0)
    size = float((high - low).max())
    middle = low + rng.uniform(-0.1, 1.1, 2) * (high - low)
    before = image.copy()
    kind = rng.random()
    if kind < 0.4:
        draw_hand(image, middle, size * rng.uniform(0.4, 0.9), rng)
    elif kind < 0.65:  # a bar over half of the picture's height or width, black most often
        color = (0, 0, 0) if rng.random() < 0.6 else random_color(rng)
        x, y = middle.astype(int).tolist()
        height, width = image.shape[:2]
        ends = [((x, 0), (width, height)), ((0, 0), (x, height)), ((0, y), (width, height)), ((0, 0), (width, y))]
        cv2.rectangle(image, *ends[int(rng.integers(4))], color, -1)
    elif kind < 0.85:
        thing = cv2.boxPoints(((middle[0], middle[1]), (size * rng.uniform(0.2, 0.9), size * rng.uniform(0.2, 0.9)),
                               float(rng.uniform(0, 180))))  # fmt: skip
        cv2.fillPoly(image, [thing.astype(np.int32)], random_color(rng, 0.2), cv2.LINE_AA)
    else:
        grip = (hull[8] + rng.normal(0, 0.1, 2) * size).astype(int)
        end = (grip + np.array([rng.normal(0, 0.6), rng.uniform(0.6, 1.5)]) * size).astype(int)
        cv2.line(image, grip.tolist(), end.tolist(), random_color(rng, 0), max(1, int(0.12 * size)), cv2.LINE_AA)
        cv2.circle(image, grip.tolist(), max(1, int(0.14 * size)), random_color(rng, 0), -1, cv2.LINE_AA)
    owner[(before != image).any(-1)] = -1


def _share_seen(owner: np.ndarray, hull: np.ndarray, number: int) -> float:
    """How much of a face's hull (P,2) in the picture is the face's own."""
    mask = np.zeros(owner.shape, dtype=np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(hull.round().clip(-20000, 20000).astype(np.int32)), 1)
    total = int(mask.sum())
    return float((owner[mask > 0] == number).sum()) / total if total else 0.0


def _share_inside(face: np.ndarray, size: int) -> float:
    """How much of a face's box lies in the picture."""
    low, high = face[:2] - face[2] / 2, face[:2] + face[2] / 2
    return float(np.prod((np.minimum(high, size) - np.maximum(low, 0)).clip(0) / face[2]))


def _photographed(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What light and a camera make of it."""
    size = image.shape[0]
    fine = math.sqrt(size / 256)  # small pictures are parts of sharper ones
    curve = np.linspace(0, 1, 256)[:, None] ** np.exp(rng.normal(0, 0.3))
    curve = curve * np.exp(rng.normal(0, 0.1, 3)) * rng.uniform(0.65, 1.2)
    if rng.random() < 0.12:  # dark
        curve = curve * rng.uniform(0.15, 0.6)
    if rng.random() < 0.15:  # hazy
        curve = rng.uniform(0, 0.4) + curve * rng.uniform(0.4, 0.8)
    taken = cv2.LUT(image, (curve.clip(0, 1) * 255).round().astype(np.uint8)[:, None])
    if rng.random() < 0.4:
        grey = cv2.cvtColor(cv2.cvtColor(taken, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
        share = 1.0 if rng.random() < 0.7 else float(rng.uniform(-0.6, 0.9))  # none, less or more colour
        taken = cv2.addWeighted(grey, share, taken, 1 - share, 0)
    if rng.random() < 0.35:
        taken = cv2.GaussianBlur(taken, (0, 0), fine * float(rng.uniform(0.4, 1.6)))
    if rng.random() < 0.08:  # the camera moved
        length = max(2, round(fine * rng.integers(3, 9)))
        line: np.ndarray = np.zeros((length, length), dtype=np.float32)
        line[length // 2] = 1
        middle = (length / 2 - 0.5, length / 2 - 0.5)
        line = cv2.warpAffine(line, cv2.getRotationMatrix2D(middle, float(rng.uniform(0, 180)), 1.0), (length, length))
        taken = cv2.filter2D(taken, -1, (line / max(1e-6, float(line.sum()))).astype(np.float32))
    if rng.random() < 0.15:  # few pixels, made larger
        few = int(size * rng.uniform(0.4, 0.9))
        taken = cv2.resize(cv2.resize(taken, (few, few), interpolation=cv2.INTER_AREA), (size, size))
    if rng.random() < 0.7:
        taken = _noisy(taken, 14 * rng.random() ** 2, rng)
    if rng.random() < 0.55:
        packed = cv2.imencode(".jpg", taken, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 95))])[1]
        taken = cv2.imdecode(packed, cv2.IMREAD_COLOR)  # type: ignore[assignment]
    return taken


def _noisy(image: np.ndarray, deviation: float, rng: np.random.Generator) -> np.ndarray:
    """Pixels with noise, as of a sensor; a piece of a large sheet of it, for speed."""
    sheet, size = _noise(), image.shape[0]
    count = len(sheet) - size
    if count <= 0:
        own = rng.standard_normal(image.shape, dtype=np.float32)
    else:
        row, column = rng.integers(0, count, 2)
        own = sheet[row : row + size, column : column + size]
    return cv2.convertScaleAbs((image + np.float32(deviation) * own).clip(0, 255))


@cache
def _noise() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((700, 700, 3), dtype=np.float32)
