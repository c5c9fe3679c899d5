"""Clutter of a picture: coloured walls, shapes, stripes, writing, skin, hands, cloth, screens; no faces."""

import string

import cv2
import numpy as np

from torchface.errors import ValueRangeError

Color = tuple[float, float, float]

_LETTERS = np.array(list(string.ascii_letters + string.digits + ".:-oO0() "))
# The darkest and the lightest skin, red, green, blue; others lie between.
_SKIN = np.array([[45, 28, 20], [110, 68, 48], [190, 135, 105], [245, 212, 190]], dtype=np.float32)


def random_color(rng: np.random.Generator, skin: float = 0.25) -> Color:
    """A colour, 0 to 255; of skin with this probability."""
    if rng.random() < skin:
        tone = rng.uniform(0, len(_SKIN) - 1.001)
        low = int(tone)
        drawn = _SKIN[low] + (tone - low) * (_SKIN[low + 1] - _SKIN[low])
        drawn = drawn * rng.uniform(0.7, 1.15) + rng.normal(0, 6, 3)
    else:
        grey = rng.uniform(0, 255)
        drawn = grey + (rng.uniform(0, 255, 3) - grey) * rng.uniform(0, 1) ** 2
    red, green, blue = np.clip(drawn, 0, 255).tolist()
    return red, green, blue


def clutter(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """A background, uint8 (height,width,3), red first."""
    if height < 1 or width < 1:
        raise ValueRangeError(f"clutter: found {height} x {width}, expected 1 x 1 at least")
    image = _clouds(height, width, rng)
    plain = rng.random() < 0.2
    drawn = 0 if plain else int(rng.integers(3, 26))
    kinds = (_box, _ellipse, _line, _writing, _stripes, _leaves, _limb, _spots, _cloth, _screen)
    for kind in rng.choice(len(kinds), drawn, p=[0.15, 0.13, 0.1, 0.15, 0.08, 0.06, 0.13, 0.08, 0.07, 0.05]):
        kinds[kind](image, rng)  # each over those before
    if rng.random() < 0.4:
        image = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.5, 4)))
    return image


def draw_hand(
    image: np.ndarray, middle: np.ndarray, size: float, rng: np.random.Generator, turn: float | None = None
) -> None:
    """A hand with its arm, as long as ``size`` pixels without it, at ``middle``, painted into an image uint8 (H,W,3).

    Its fingers' direction is turned clockwise by ``turn`` radians from pointing right; by any if absent.
    """
    skin = np.array(random_color(rng, 1.0))
    turn = rng.uniform(0, 2 * np.pi) if turn is None else turn
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    palm = middle + rng.normal(0, 0.1, 2) * size
    _capsule(image, palm, palm - along * size * rng.uniform(0.8, 3), 0.34 * size, skin * rng.uniform(0.6, 1.0))
    spread = rng.uniform(0.05, 0.5)
    for finger in range(5):
        lean = (finger - 2) * spread
        way = along * np.cos(lean) + across * np.sin(lean)
        root = palm + across * (finger - 2) * 0.1 * size + along * 0.1 * size
        tip = root + way * size * rng.uniform(0.2, 0.55)
        _capsule(image, root, tip, rng.uniform(0.1, 0.14) * size, skin * rng.uniform(0.82, 1.05))
    cv2.ellipse(
        image,
        _at(palm),
        _axes(0.26 * size, 0.22 * size),
        float(np.degrees(turn)),
        0,
        360,
        _clipped(skin),
        -1,
        cv2.LINE_AA,
    )


def _clouds(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """One colour, or one that runs into another, with clouds of all sizes."""
    base = np.array(random_color(rng, 0.1), dtype=np.float32)
    image: np.ndarray = np.broadcast_to(base, (2, 2, 3))
    if rng.random() < 0.5:
        image = np.array([random_color(rng, 0.1) for _ in range(4)], dtype=np.float32).reshape(2, 2, 3)
    for octave in range(1, 8):
        side = 2**octave + 1
        image = cv2.resize(image, (side, side), interpolation=cv2.INTER_LINEAR)
        if rng.random() < 0.55:
            amount = np.float32(rng.uniform(0, 70) * 0.75**octave)
            grey = rng.standard_normal((side, side, 1), dtype=np.float32)
            colors = rng.standard_normal((side, side, 3), dtype=np.float32) * np.float32(0.5 * rng.random())
            image = image + amount * (grey + colors)
    image = cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.clip(image, 0, 255).astype(np.uint8)


def _place(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-0.1, 1.1, 2) * (image.shape[1], image.shape[0])


def _size(image: np.ndarray, rng: np.random.Generator) -> float:
    """Of a shape, pixels: as many small as large ones."""
    return float(np.exp(rng.uniform(np.log(5), np.log(0.8 * max(image.shape[:2])))))


def _box(image: np.ndarray, rng: np.random.Generator) -> None:
    size, tilt = _size(image, rng), rng.choice([0.0, 0.0, rng.uniform(0, 180)])
    corners = cv2.boxPoints((tuple(_place(image, rng)), (size, size * rng.uniform(0.1, 1.5)), tilt))
    cv2.fillPoly(image, [corners.astype(np.int32)], random_color(rng), cv2.LINE_AA)
    if rng.random() < 0.4:
        cv2.polylines(image, [corners.astype(np.int32)], True, random_color(rng), int(rng.integers(1, 6)), cv2.LINE_AA)


def _ellipse(image: np.ndarray, rng: np.random.Generator) -> None:
    """An oval; of skin and with a cap of hair it is like a head without a face."""
    size, middle, tilt = _size(image, rng), _place(image, rng), float(rng.uniform(0, 360))
    axes = _axes(size / 2, size * rng.uniform(0.2, 0.5))
    cv2.ellipse(image, _at(middle), axes, tilt, 0, 360, random_color(rng, 0.5), -1, cv2.LINE_AA)
    if rng.random() < 0.4:
        cv2.ellipse(
            image, _at(middle), axes, tilt, 0, float(rng.uniform(90, 200)), random_color(rng, 0.1), -1, cv2.LINE_AA
        )


def _line(image: np.ndarray, rng: np.random.Generator) -> None:
    points = [_at(_place(image, rng)) for _ in range(int(rng.integers(2, 5)))]
    cv2.polylines(image, [np.array(points)], False, random_color(rng), int(rng.integers(1, 9)), cv2.LINE_AA)


def _writing(image: np.ndarray, rng: np.random.Generator) -> None:
    """Lines of letters, on a sheet or on nothing."""
    place, scale = _place(image, rng), float(np.exp(rng.uniform(np.log(0.25), np.log(2.5))))
    ink, thick, font = random_color(rng, 0), max(1, int(scale * rng.uniform(1, 3))), int(rng.integers(0, 8))
    if rng.random() < 0.5:
        low, high = _at(place - 12 * scale), _at(place + np.array([rng.uniform(60, 300), rng.uniform(30, 200)]) * scale)
        cv2.rectangle(image, low, high, random_color(rng, 0.05), -1)
    for row in range(int(rng.integers(1, 7))):
        text = "".join(rng.choice(_LETTERS, int(rng.integers(2, 20))))
        cv2.putText(
            image, text, _at(place + np.array([0, 26 * scale * (row + 0.5)])), font, scale, ink, thick, cv2.LINE_AA
        )


def _stripes(image: np.ndarray, rng: np.random.Generator) -> None:
    """Stripes or checks on a piece of the image."""
    size = int(_size(image, rng)) + 6
    pitch, turn = rng.uniform(3, 40), rng.uniform(0, np.pi)
    rows, columns = np.mgrid[:size, :size]
    along = columns * np.cos(turn) + rows * np.sin(turn)
    bright = np.sin(2 * np.pi * along / pitch) > rng.uniform(-0.6, 0.6)
    if rng.random() < 0.4:
        bright ^= np.sin(2 * np.pi * (rows * np.cos(turn) - columns * np.sin(turn)) / pitch) > 0
    pattern = np.where(bright[..., None], random_color(rng), random_color(rng)).astype(np.uint8)
    x, y = _at(_place(image, rng) - size / 2)
    left, top = max(0, x), max(0, y)
    part = image[top : max(0, y + size), left : max(0, x + size)]
    part[:] = pattern[top - y :, left - x :][: part.shape[0], : part.shape[1]]


def _leaves(image: np.ndarray, rng: np.random.Generator) -> None:
    """Many small ovals of like colours."""
    middle, spread, size = _place(image, rng), _size(image, rng), rng.uniform(2, 14)
    color = np.array(random_color(rng, 0.1))
    for _ in range(int(rng.integers(15, 70))):
        own = _clipped(color * rng.uniform(0.5, 1.4))
        axes = _axes(size * rng.uniform(0.5, 1.5), size * rng.uniform(0.2, 0.8))
        cv2.ellipse(
            image, _at(middle + rng.normal(0, spread / 2, 2)), axes, float(rng.uniform(0, 180)), 0, 360, own, -1
        )


def _limb(image: np.ndarray, rng: np.random.Generator) -> None:
    """A hand, or an arm alone."""
    middle, size = _place(image, rng), _size(image, rng)
    if rng.random() < 0.6:
        draw_hand(image, middle, size, rng)
    else:
        far = middle + rng.normal(0, 1, 2) * size
        _capsule(image, middle, far, rng.uniform(0.1, 0.5) * size, np.array(random_color(rng, 0.7)))


def _spots(image: np.ndarray, rng: np.random.Generator) -> None:
    """A few round marks beside each other on a ground: buttons, lamps, wheels; not in a face's places."""
    middle, size, count = _place(image, rng), _size(image, rng), int(rng.integers(2, 9))
    way = rng.normal(0, 1, 2)
    way *= size / count / max(1e-6, float(np.hypot(way[0], way[1])))
    color, radius = random_color(rng), rng.uniform(0.15, 0.45) * size / count
    if rng.random() < 0.6:
        ground = np.array(random_color(rng, 0.5))
        _capsule(image, middle - way, middle + way * count, rng.uniform(1, 3) * size / count, ground)
    for number in range(count):
        cv2.circle(image, _at(middle + way * number), max(1, int(radius)), color, -1, cv2.LINE_AA)


def _cloth(image: np.ndarray, rng: np.random.Generator) -> None:
    """Cloth of one colour, warm ones most often, with soft folds and a hem."""
    size = int(_size(image, rng)) + 8
    x, y = _at(_place(image, rng) - size / 2)
    left, top = max(0, x), max(0, y)
    part = image[top : max(0, y + size), left : max(0, x + size)]
    if not part.size:
        return
    warm = np.array([rng.uniform(120, 255), rng.uniform(30, 170), rng.uniform(0, 110)])
    color = warm if rng.random() < 0.5 else np.array(random_color(rng, 0.2))
    coarse = rng.normal(0, 1, (int(rng.integers(3, 9)), int(rng.integers(3, 9)))).astype(np.float32)
    folds = cv2.resize(coarse, (part.shape[1], part.shape[0]), interpolation=cv2.INTER_CUBIC)[..., None]
    part[:] = np.clip(color * (1 + rng.uniform(0.05, 0.35) * folds), 0, 255).astype(np.uint8)
    if rng.random() < 0.5:
        cv2.rectangle(image, (left, top), (x + size, y + size), random_color(rng), int(rng.integers(1, 5)), cv2.LINE_AA)


def _screen(image: np.ndarray, rng: np.random.Generator) -> None:
    """A monitor, a window, a picture without people: a frame round something bright or dark, with boxes and writing."""
    size, middle = _size(image, rng), _place(image, rng)
    half = size * np.array([0.5, rng.uniform(0.25, 0.45)])
    low, far = _at(middle - half), _at(middle + half)
    cv2.rectangle(image, low, far, random_color(rng, 0), -1)
    for _ in range(int(rng.integers(0, 8))):  # over each other
        first = middle + rng.uniform(-0.9, 0.7, 2) * half
        cv2.rectangle(image, _at(first), _at(first + rng.uniform(0.03, 0.4, 2) * size), random_color(rng, 0.1), -1)
    if rng.random() < 0.6:
        text = "".join(rng.choice(_LETTERS, int(rng.integers(2, 12))))
        cv2.putText(image, text, _at(middle - (0.8 * half[0], 0)), int(rng.integers(0, 8)), size / 200,
                    random_color(rng, 0), 1, cv2.LINE_AA)  # fmt: skip
    cv2.rectangle(image, low, far, random_color(rng, 0), max(1, int(size * rng.uniform(0.01, 0.08))), cv2.LINE_AA)


def _capsule(image: np.ndarray, start: np.ndarray, end: np.ndarray, thick: float, color: np.ndarray) -> None:
    cv2.line(image, _at(start), _at(end), _clipped(color), max(1, int(thick)), cv2.LINE_AA)


def _at(point: np.ndarray) -> tuple[int, int]:
    x, y = np.clip(np.asarray(point), -20000, 20000).tolist()
    return int(x), int(y)


def _axes(first: float, second: float) -> tuple[int, int]:
    return max(1, int(first)), max(1, int(second))


def _clipped(color: np.ndarray) -> Color:
    red, green, blue = np.clip(color, 0, 255).tolist()
    return red, green, blue
