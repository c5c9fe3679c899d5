"""Crops of cut-out faces as cameras might show them: turned, before walls, hidden in part, blurred, compressed."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.landmarks.images.ibug_68 import COUNT, MIRROR_68, box_around

Uniform = Callable[[float, float], float]  # a number drawn between two others

_EYES, _MOUTH = slice(36, 48), slice(48, 68)


@dataclass(frozen=True)
class AugmentationSettings:
    """How widely crops are drawn; shares lie in [0,1]."""

    # standard deviation of the tilt that a tracker leaves, degrees; one crop in four is turned by up to 45
    turn: float = 11.0
    scale: float = 0.22  # how much larger or smaller than its box a face may be, as a logarithm
    shift: float = 0.05  # standard deviation of its place, of the box
    hidden: float = 0.4  # share of crops with something before the face
    absent: float = 0.12  # share of crops that show no face, or one in the wrong place
    grey: float = 0.15  # share of crops without colour


@dataclass(frozen=True, eq=False)
class Crops:
    """What a network is shown, and what it should answer."""

    images: Tensor  # (B,3,S,S) in [0,1]
    landmarks: Tensor  # (B,68+P,2) pixels
    visible: Tensor  # (B,68+P) in [0,1]
    present: Tensor  # whether a face is there, (B,) in [0,1]
    mirrored: Tensor  # whether left and right are exchanged, (B,) bool


def augmented(
    rgba: Tensor,
    landmarks: Tensor,
    visible: Tensor,
    size: int,
    margin: float,
    generator: torch.Generator,
    settings: AugmentationSettings | None = None,
    mirror: Tensor | None = None,
) -> Crops:
    """Draws a crop of each picture.

    Args:
        rgba: cut-out faces, uint8 (B,4,H,W).
        landmarks: iBUG's 68 and P other points, (B,68+P,2) pixels.
        visible: which of them nothing hides, (B,68+P) bool.
        margin: a crop's side, of the side of the face's box.
        mirror: which of the other points each becomes in a mirror, (P,) int64; without any if absent.
    """
    settings = settings or AugmentationSettings()
    count, twins = len(rgba), torch.tensor(MIRROR_68)
    if mirror is not None:
        twins = torch.cat([twins, COUNT + mirror])

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    present = (rand(count) >= settings.absent).float()
    mirrored = rand(count) < 0.5
    across = landmarks[:, twins].clone()
    across[..., 0] = rgba.shape[-1] - 1 - across[..., 0]
    points = torch.where(mirrored[:, None, None], across, landmarks)
    seen = torch.where(mirrored[:, None], visible[:, twins], visible).float()
    box = box_around(points[:, :COUNT])
    turn = torch.where(rand(count) < 0.25, 45 * (2 * rand(count) - 1), settings.turn * randn(count).clamp(-2.5, 2.5))
    side = box[:, 2] * margin * (settings.scale * (2 * rand(count) - 1)).exp()
    shift = settings.shift * randn(count, 2).clamp(-2.5, 2.5)
    # Half of what shows no face shows one where none is looked for; the network learns to distinguish the two.
    astray = (present == 0) & (rand(count) < 0.5)
    way = torch.nn.functional.normalize(randn(count, 2), dim=1)
    shift = torch.where(astray[:, None], way * (0.55 + 0.5 * rand(count, 1)), shift)
    side = torch.where(astray & (rand(count) < 0.3), side * 2.6, side)
    # A face that stands on its side or its head in the crop is in the wrong place too: its tilt is not the one stated.
    overturned = astray & (rand(count) < 0.5)
    turn = torch.where(overturned, 75 + 210 * rand(count), turn)
    shift = torch.where(overturned[:, None], 0.05 * way, shift)
    middle = box[:, :2] + box[:, 2:] / 2 + shift * box[:, 2:]
    to_crop = to_crop_maps(middle, side, torch.deg2rad(turn), size)
    mirror = torch.where(mirrored, -1.0, 1.0)[:, None] * torch.tensor([1.0, 0.0]) + torch.tensor([0.0, 1.0])
    from_picture = to_crop * torch.cat([mirror, torch.ones(count, 1)], dim=1)[:, None]
    from_picture[..., 2] += torch.where(mirrored, rgba.shape[-1] - 1.0, 0.0)[:, None] * to_crop[..., 0]
    cut = _warped(rgba, from_picture, size)
    points = points @ to_crop[:, :, :2].transpose(1, 2) + to_crop[:, None, :, 2]
    alpha = cut[:, 3:] * (1 - ((present == 0) & ~astray).float())[:, None, None, None]
    images = cut[:, :3] * alpha + _walls(count, size, generator) * (1 - alpha)
    images, seen = _with_occluders(images, points, seen, settings, generator)
    images = photographed(images, settings, generator)
    inside = ((points > -0.5) & (points < size - 0.5)).all(-1).float()
    return Crops(images, points, seen * inside, present, mirrored)


def _warped(pictures: Tensor, maps: Tensor, size: int) -> Tensor:
    """Pictures uint8 (B,4,H,W) under affine maps (B,2,3), (B,4,S,S) in [0,1]; 0 beyond their edges."""
    # OpenCV's bytes take a third of the time of kornia's floats, and training waits for the crops.
    warped = [
        cv2.warpAffine(np.ascontiguousarray(picture), one, (size, size), flags=cv2.INTER_LINEAR)
        for picture, one in zip(pictures.permute(0, 2, 3, 1).numpy(), maps.double().numpy(), strict=True)
    ]
    return torch.from_numpy(np.stack(warped)).permute(0, 3, 1, 2).float() / 255


def to_crop_maps(middle: Tensor, side: Tensor, turn: Tensor, size: int) -> Tensor:
    """Affine maps (B,2,3) from pictures to crops about a middle (B,2), turned counter-clockwise by ``turn``."""
    zoom = size / side
    cosine, sine = zoom * turn.cos(), zoom * turn.sin()
    linear = torch.stack([torch.stack([cosine, sine], -1), torch.stack([-sine, cosine], -1)], dim=1)
    centre = (size - 1) / 2
    return torch.cat([linear, (centre - (linear @ middle[..., None])[..., 0])[..., None]], dim=2)


def _walls(count: int, size: int, generator: torch.Generator) -> Tensor:
    """Backgrounds (B,3,S,S): clouds of colour of several sizes with stripes, edges and patches."""
    base = torch.rand(count, 1, 1, 1, generator=generator)
    base = base + 0.35 * (torch.rand(count, 3, 1, 1, generator=generator) - 0.5)
    walls = base.expand(-1, -1, size, size).clone()
    size, whole = size // 2, size
    walls = walls[..., :size, :size]
    for cells in (2, 5, 12, 40):  # from broad to fine
        amount = 0.4 * torch.rand(count, 1, 1, 1, generator=generator) ** 2
        grey = torch.randn(count, 1, cells, cells, generator=generator)
        tone = grey + 0.3 * torch.randn(count, 3, cells, cells, generator=generator)
        smooth = "bilinear" if cells in (2, 12) else "nearest"
        walls = walls + amount * torch.nn.functional.interpolate(tone, (size, size), mode=smooth)
    line = torch.linspace(0, 1, size)
    angle, pitch = 6.3 * torch.rand(count, generator=generator), 60 * torch.rand(count, generator=generator) ** 2
    run = angle.cos()[:, None, None] * line + angle.sin()[:, None, None] * line[:, None]
    stripes = torch.sign(torch.sin(pitch[:, None, None] * run))[:, None]
    strength = 0.25 * (torch.rand(count, 1, 1, 1, generator=generator) < 0.2).float()
    walls = torch.nn.functional.interpolate((walls + strength * stripes).clamp(0, 1), (whole, whole), mode="bilinear")
    sharp = 0.12 * torch.rand(count, 1, 1, 1, generator=generator) ** 3
    return walls + sharp * torch.randn(1, 1, whole, whole, generator=generator)


def _with_occluders(
    images: Tensor, points: Tensor, seen: Tensor, settings: AugmentationSettings, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Hands, microphones, bars, hair and black patches before faces; what they hide is no longer visible."""
    size = images.shape[-1]
    drawn, left = images.permute(0, 2, 3, 1).contiguous().numpy(), seen.clone()

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    for number, picture in enumerate(drawn):  # each has shapes of its own
        if uniform(0, 1) < 0.15:
            _hair(picture, uniform)
        if uniform(0, 1) >= settings.hidden:
            continue
        cover = np.zeros((size, size), dtype=np.float32)
        kind, where = uniform(0, 1), points[number]
        if kind < 0.2:  # half of the face, or eyes, or mouth, as a hard patch
            rows = (_EYES, _MOUTH)[int(uniform(0, 1.999))] if uniform(0, 1) < 0.6 else slice(0, 68)
            low, high = where[rows].amin(0), where[rows].amax(0)
            if rows == slice(0, 68):
                edge = int(uniform(0, 3.999))
                low, high = low - size, high + size
                middle = where[27:36].mean(0) + size * torch.tensor([uniform(-0.1, 0.1), uniform(-0.1, 0.1)])
                (high if edge < 2 else low)[edge % 2] = middle[edge % 2]
            pad = uniform(0.5, 6)
            (left_edge, top), (right_edge, bottom) = (low - pad).int().tolist(), (high + pad).int().tolist()
            cv2.rectangle(cover, (left_edge, top), (right_edge, bottom), 1.0, -1)
        elif kind < 0.65:  # fingers, or the side of a hand
            start = np.array([uniform(0, size), uniform(0.2 * size, size)])
            tilt, width = uniform(0, 6.3), uniform(0.05, 0.14) * size
            for finger in range(int(uniform(1, 4.999))):
                begin = start + finger * 1.05 * width * np.array([-math.sin(tilt), math.cos(tilt)])
                end = begin + uniform(0.3, 0.8) * size * np.array([math.cos(tilt), math.sin(tilt)])
                ends = (*map(int, 8 * begin),), (*map(int, 8 * end),)
                cv2.line(cover, *ends, 1.0, max(1, int(width)), cv2.LINE_AA, 3)
        else:  # a cup, a microphone, a scarf
            centre = int(uniform(0, size)), int(uniform(0.2 * size, 1.1 * size))
            axes = int(uniform(0.05, 0.3) * size), int(uniform(0.05, 0.3) * size)
            cv2.ellipse(cover, centre, axes, uniform(0, 180), 0, 360, 1.0, -1, cv2.LINE_AA)
            if uniform(0, 1) < 0.5:
                foot = int(centre[0] + uniform(-30, 30)), size
                cv2.line(cover, centre, foot, 1.0, max(1, int(0.4 * axes[0])), cv2.LINE_AA)
        picture[:] = _covered(picture, cover, where, kind < 0.2, uniform)
        at = where.round().long().clamp(0, size - 1)
        left[number] = left[number] * torch.from_numpy(1 - cover[at[:, 1], at[:, 0]]).round()
    return torch.from_numpy(drawn).permute(0, 3, 1, 2), left


def _covered(picture: np.ndarray, cover: np.ndarray, where: Tensor, hard: bool, uniform: Uniform) -> np.ndarray:
    """A picture (S,S,3) with a tone over the covered part: black, the skin's own with shading, or any colour."""
    size = len(cover)
    if hard and uniform(0, 1) < 0.7:
        tone = np.zeros((1, 1, 3), dtype=np.float32)
    elif uniform(0, 1) < 0.55:
        x, y = where[30].round().long().clamp(0, size - 1).tolist()
        tone = picture[y, x][None, None] * uniform(0.7, 1.15)
    else:
        tone = np.array([uniform(0, 1), uniform(0, 1), uniform(0, 1)], dtype=np.float32)[None, None]
    depth = cv2.distanceTransform((cover > 0.5).astype(np.uint8), cv2.DIST_L2, 3)
    round_shade = np.clip(0.55 + 0.45 * depth / max(3.0, 0.6 * float(depth.max())), 0, 1)[..., None]
    if hard:
        round_shade = np.ones_like(round_shade)
    return picture * (1 - cover[..., None]) + np.clip(tone * round_shade, 0, 1) * cover[..., None]


def _hair(picture: np.ndarray, uniform: Uniform) -> None:
    """Strands that fall from above, drawn into a picture (S,S,3)."""
    size, grey = len(picture), uniform(0.02, 0.5)
    tone = (grey * 1.1, grey * 0.85, grey * 0.7)
    start, lean = uniform(0, size), uniform(-0.5, 0.5)
    for _ in range(int(uniform(1, 14))):
        x, y = start + uniform(-10, 10), uniform(-10, 0.2 * size)
        length, bend = uniform(0.2, 0.6) * size, uniform(-0.3, 0.3)
        t = np.linspace(0, 1, 8)
        curve = np.stack([x + length * (lean * t + bend * t * t), y + length * t], axis=1)
        cv2.polylines(picture, [(8 * curve).round().astype(np.int32)], False, tone, 1, cv2.LINE_AA, 3)


def with_light(images: Tensor, generator: torch.Generator, grey_share: float = 0.15) -> Tensor:
    """Images (B,3,H,W) of other brightness, contrast and colour, as lights and cameras differ; a share is grey."""
    # Loaded here, as below: kornia takes half a second, and what finds faces never blurs.
    from kornia.color import rgb_to_grayscale

    count = len(images)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    gain = (0.4 * (2 * rand(count, 1, 1, 1) - 1)).exp() * (1 + 0.1 * (2 * rand(count, 3, 1, 1) - 1))
    dark = torch.where(rand(count, 1, 1, 1) < 0.06, 0.1 + 0.3 * rand(count, 1, 1, 1), 1.0)
    images = (images * gain * dark).clamp(1e-4, 1) ** (0.45 * (2 * rand(count, 1, 1, 1) - 1)).exp()
    mean = images.mean((1, 2, 3), keepdim=True)
    images = mean + (images - mean) * (0.6 + 0.7 * rand(count, 1, 1, 1))
    grey = rgb_to_grayscale(images.clamp(0, 1))
    saturation = torch.where(rand(count, 1, 1, 1) < grey_share, 0.0, 0.5 + 0.8 * rand(count, 1, 1, 1))
    return (grey + saturation * (images - grey)).clamp(0, 1)


def with_blur(images: Tensor, generator: torch.Generator, share: float, widest: float) -> Tensor:
    """Images (B,3,H,W), changed in place, of which a share is out of focus by 0.3 to ``widest`` more, and an eighth
    moves."""
    from kornia.filters import gaussian_blur2d, motion_blur

    count = len(images)
    soft = (torch.rand(count, generator=generator) < share).nonzero()[:, 0]
    if len(soft):
        sigma = (0.3 + widest * torch.rand(len(soft), 1, generator=generator) ** 2).expand(-1, 2)
        images[soft] = gaussian_blur2d(images[soft], (9, 9), sigma)
    moving = (torch.rand(count, generator=generator) < 0.12).nonzero()[:, 0]
    if len(moving):
        angle = 360 * torch.rand(len(moving), generator=generator)
        images[moving] = motion_blur(images[moving], 7, angle, torch.zeros(len(moving)))
    return images


def photographed(images: Tensor, settings: AugmentationSettings, generator: torch.Generator) -> Tensor:
    """What lights, lenses, sensors and codecs make of crops (B,3,S,S)."""
    count, _, size, _ = images.shape

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    images = with_blur(with_light(images, generator, settings.grey), generator, 0.45, 1.3)
    noise = (0.045 * rand(count, 1, 1, 1) ** 2) * torch.randn(images.shape, generator=generator)
    images = (images + noise).clamp(0, 1)
    small = (rand(count) < 0.3).nonzero()[:, 0].tolist()
    coded = (rand(count) < 0.45).nonzero()[:, 0].tolist()
    share, quality = 0.3 + 0.55 * rand(count), (20 + 70 * rand(count)).long()
    dim, smooth, sharp = (torch.nonzero(rand(count) < part)[:, 0].tolist() for part in (0.2, 0.15, 0.2))
    strength = rand(count, 3).tolist()
    stored = (255 * images).round().byte().permute(0, 2, 3, 1).contiguous().numpy()
    for number in {*small, *coded, *dim, *smooth, *sharp}:  # cameras and codecs take an image at a time
        picture = stored[number]
        if number in small:
            side = max(16, int(size * float(share[number])))
            picture = cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
        if number in dim:
            picture = _grained(picture, 6 + 24 * strength[number][0] ** 2, generator)
        if number in smooth:  # a camera that takes the grain away, and the skin's with it
            picture = cv2.bilateralFilter(picture, 5, 15 + 45 * strength[number][1], 2.0)
        if number in sharp:  # and one that draws bright seams along edges
            soft = cv2.GaussianBlur(picture, (0, 0), 0.8 + 0.8 * strength[number][2])
            picture = cv2.addWeighted(picture, 1.4 + strength[number][2], soft, -0.4 - strength[number][2], 0)
        if number in coded:
            code = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, int(quality[number])])[1]
            picture = cv2.imdecode(code, cv2.IMREAD_COLOR)
        if number in small:
            way = cv2.INTER_CUBIC if strength[number][0] < 0.3 else cv2.INTER_LINEAR
            picture = cv2.resize(picture, (size, size), interpolation=way)
        stored[number] = picture
    return torch.from_numpy(stored).permute(0, 3, 1, 2).float() / 255


def _grained(picture: np.ndarray, deviation: float, generator: torch.Generator) -> np.ndarray:
    """A picture uint8 (S,S,3) in dim light: grain in spots of more than a pixel, of colours more than of lightness."""
    side = len(picture)
    grain = torch.randn(side, side, 3, generator=generator).numpy()
    grain = 1.2 * grain + 0.8 * grain.mean(2, keepdims=True)
    spots = cv2.GaussianBlur(grain, (0, 0), 0.7)
    light = np.sqrt(0.15 + picture.astype(np.float32) / 255)
    return np.clip(picture + deviation * light * spots, 0, 255).astype(np.uint8)
