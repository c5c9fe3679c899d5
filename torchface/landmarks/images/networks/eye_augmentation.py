"""Crops of rendered eyes as cameras might show them: beside their place, far away, hidden, in glare, compressed."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.landmarks.images.networks.eye_crop import EYE_LANDMARKS, eye_transforms, moved
from torchface.landmarks.images.networks.picture_augmentation import with_blur, with_light

_SHUT, _OPEN = 10.0, 28.0  # square millimetres of eyeball up to which an eye is shut, and from which it is not


@dataclass(frozen=True)
class EyeAugmentation:
    """How widely crops are drawn; shares lie in [0,1]."""

    turn: float = 12.0  # largest roll angle that landmarks leave, degrees
    scale: float = 0.2  # how much larger or smaller than its crop an eye may be, as a logarithm
    shift: float = 0.12  # how far it may lie aside, of the crop
    hidden: float = 0.22  # share of crops with something before the eye
    absent: float = 0.06  # share of crops that show no eye
    far: float = 0.55  # share of crops of faces that are small in their picture
    # Pixels of their pictures in one of the crop, for the smallest and the largest of them.
    sizes: tuple[float, float] = (0.2, 1.0)


@dataclass(frozen=True, eq=False)
class EyeCrops:
    """What a network is shown, and what it should answer."""

    images: Tensor  # (B,3,h,w) in [0,1]
    points: Tensor  # six of the lids and the iris's centre, (B,7,2) pixels
    seen: Tensor  # which of them can be seen, (B,7) in [0,1]; the iris's centre of a shut eye cannot
    openness: Tensor  # of the lids, (B,)
    closed: Tensor  # whether the eye is shut, (B,) in [0,1]
    visibility: Tensor  # whether nothing hides it, (B,) in [0,1]
    present: Tensor  # whether an eye is there, (B,) in [0,1]


@dataclass(frozen=True, eq=False)
class EyeLabels:
    """What is known of pictures of both eyes, the person's right one first."""

    landmarks: Tensor  # iBUG's 68, (M,68,2) pixels
    visible: Tensor  # which of 36 to 47 nothing hides, (M,12) bool
    iris: Tensor  # centres of the irises, (M,2,2) pixels
    openness: Tensor  # the lids' distance over that of the corners, on the head, (M,2)
    bare: Tensor  # how much of each eyeball is seen, (M,2) square millimetres


def augmented_eyes(
    rgba: Tensor,
    labels: EyeLabels,
    eyes: Tensor,
    width: int,
    height: int,
    generator: torch.Generator,
    settings: EyeAugmentation | None = None,
) -> EyeCrops:
    """Draws a crop of one eye, 0 for the right one, of each cut-out picture uint8 (B,4,H,W)."""
    from kornia.geometry.transform import warp_affine  # loaded here: it takes half a second

    settings = settings or EyeAugmentation()
    count, each = len(rgba), torch.arange(len(rgba))

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    order = torch.tensor(EYE_LANDMARKS)[eyes]
    truth = torch.cat([labels.landmarks[each[:, None], order], labels.iris[each, eyes][:, None]], dim=1)
    seen = labels.visible[each[:, None], order - 36].float()
    iris_seen = (labels.bare[each, eyes] > _SHUT).float()[:, None] * seen[:, [1, 2, 4, 5]].amax(1, keepdim=True)
    present = (rand(count) >= settings.absent).float()
    transforms = eye_transforms(labels.landmarks, width, height)[each, eyes]
    transforms = _jittered(transforms, present, width, height, generator, settings)
    points = moved(truth, transforms)
    cut = warp_affine(rgba.float(), transforms, (height, width), padding_mode="border", align_corners=True)
    images, alpha = cut[:, :3] / 255, cut[:, 3:] / 255
    images = images + _behind(count, height, width, generator) * (1 - alpha)
    images = with_light(images, generator)
    seen = torch.cat([seen, iris_seen], dim=1)
    images, covered = _with_occluders(images, points, settings, generator)
    seen = seen * (1 - covered)
    images = _as_cameras_store(images, settings, generator)
    inside = ((points > -0.5) & (points < points.new_tensor([width, height]) - 0.5)).all(-1).float()
    lids = (seen * inside)[:, :6].mean(1)
    visibility = ((lids - 0.35) / 0.3).clamp(0, 1) * present
    closed = ((_OPEN - labels.bare[each, eyes]) / (_OPEN - _SHUT)).clamp(0, 1)
    return EyeCrops(images, points, seen * inside, labels.openness[each, eyes], closed, visibility, present)


def _jittered(
    transforms: Tensor, present: Tensor, width: int, height: int, generator: torch.Generator, settings: EyeAugmentation
) -> Tensor:
    """Transforms (B,2,3) to crops that lie, as landmarks err, a little beside; far beside where no eye is present."""
    count = len(transforms)

    def spread(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, generator=generator) - 1

    # Two numbers together fall near the middle more often than at the ends.
    turn = torch.deg2rad(torch.tensor(settings.turn)) * (spread(count) + spread(count)) / 2 * 1.4
    zoom = (settings.scale * spread(count)).exp()
    size = torch.tensor([float(width), float(height)])
    shift = settings.shift * (spread(count, 2) + 0.5 * spread(count, 2)) / 1.5 * size[0]
    way = torch.rand(count, generator=generator) * 2 * math.pi
    beside = (
        torch.stack([0.9 * way.cos(), 0.9 * way.sin()], -1) * size * (1 + torch.rand(count, 1, generator=generator))
    )
    shift = torch.where(present[:, None] > 0, shift, beside)
    cosine, sine = zoom * turn.cos(), zoom * turn.sin()
    jitter = torch.stack([torch.stack([cosine, sine], -1), torch.stack([-sine, cosine], -1)], dim=1)
    middle = (size - 1) / 2
    linear = jitter @ transforms[..., :2]
    offset = (jitter @ (transforms[..., 2:] - middle[:, None]))[..., 0] + middle + shift
    return torch.cat([linear, offset[..., None]], -1)


def _behind(count: int, height: int, width: int, generator: torch.Generator) -> Tensor:
    """Backgrounds (B,3,h,w): a colour with clouds."""
    base = torch.rand(count, 3, 1, 1, generator=generator) * torch.rand(count, 1, 1, 1, generator=generator)
    clouds = torch.randn(count, 3, 3, 4, generator=generator)
    clouds = torch.nn.functional.interpolate(clouds, (height, width), mode="bilinear")
    return (base + 0.15 * clouds).clamp(0, 1)


def _with_occluders(
    images: Tensor, points: Tensor, settings: EyeAugmentation, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Fingers, strands of hair, patches and glare before eyes; and how much of each point they cover, (B,7)."""
    height, width = images.shape[2:]
    drawn, covered = images.permute(0, 2, 3, 1).contiguous().numpy(), torch.zeros(points.shape[:2])

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    for number, picture in enumerate(drawn):  # each has shapes of its own
        if uniform(0, 1) >= settings.hidden:
            continue
        cover = np.zeros((height, width), dtype=np.float32)
        kind, share = uniform(0, 1), 1.0
        at = np.array([uniform(0, width), uniform(0, height)])
        way, tone = uniform(0, 2 * math.pi), np.array([uniform(0, 1) for _ in range(3)])
        along = np.array([math.cos(way), math.sin(way)])
        if kind < 0.35:  # a finger or the side of a hand, of about the skin's colour
            thick = uniform(0.15, 0.9) * height
            ends = [(*(8 * (at + side * 2 * width * along)).round().astype(int).tolist(),) for side in (0, 1)]
            cv2.line(cover, ends[0], ends[1], 1.0, max(1, int(thick)), cv2.LINE_AA, 3)
            tone = picture.reshape(-1, 3).mean(0) * uniform(0.6, 1.3)
        elif kind < 0.65:  # strands of hair
            tone = np.array([1.1, 0.85, 0.7]) * uniform(0.02, 0.5)
            for _ in range(int(uniform(1, 10))):
                start = at + np.array([uniform(-8, 8), -height])
                bend = uniform(-0.4, 0.4)
                t = np.linspace(0, 1, 8)[:, None]
                curve = start + 2.5 * height * (t * np.array([uniform(-0.3, 0.3), 1.0]) + t * t * np.array([bend, 0.0]))
                cv2.polylines(cover, [(8 * curve).round().astype(np.int32)], False, 1.0, 1, cv2.LINE_AA, 3)
            share = uniform(0.5, 1.0)
        elif kind < 0.8:  # a patch
            axes = (int(uniform(4, 0.6 * width)), int(uniform(3, 0.6 * height)))
            cv2.ellipse(cover, (*at.astype(int).tolist(),), axes, math.degrees(way), 0, 360, 1.0, -1, cv2.LINE_AA)
        else:  # light that a lens mirrors
            axes = (int(uniform(4, 0.5 * width)), int(uniform(2, 0.4 * height)))
            cv2.ellipse(cover, (*at.astype(int).tolist(),), axes, math.degrees(way), 0, 360, 1.0, -1, cv2.LINE_AA)
            cover = cv2.GaussianBlur(cover, (0, 0), uniform(0.5, 4)).astype(np.float32)
            tone, share = np.array([0.9, 0.95, 1.0]) * uniform(0.6, 1.0), uniform(0.2, 1.0)
        opacity = share * cover[..., None]
        picture[:] = picture * (1 - opacity) + np.clip(tone, 0, 1) * opacity
        spots = points[number].round().long()
        x, y = spots[:, 0].clamp(0, width - 1), spots[:, 1].clamp(0, height - 1)
        covered[number] = torch.from_numpy((opacity[y, x, 0] > 0.6).astype(np.float32))
    return torch.from_numpy(drawn).permute(0, 3, 1, 2), covered


def _as_cameras_store(images: Tensor, settings: EyeAugmentation, generator: torch.Generator) -> Tensor:
    """Blurred, moving, noisy, few pixels, compressed: crops (B,3,h,w) as they come out of cameras and codecs."""
    count, _, height, width = images.shape

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    images = with_blur(images, generator, 0.4, 1.7)
    far, coded = rand(count) < settings.far, rand(count) < 0.5
    small, large = (math.log(size) for size in settings.sizes)
    share = torch.where(far, (large + (small - large) * rand(count)).exp(), 1.0)
    quality, grain = (25 + 70 * rand(count)).long(), 0.06 * rand(count) ** 2
    sharp = rand(count) < 0.2
    pictures = images.permute(0, 2, 3, 1).contiguous().numpy()
    for number in range(count):  # sizes differ
        picture = pictures[number]
        size = (max(6, round(width * float(share[number]))), max(4, round(height * float(share[number]))))
        if far[number]:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        noise = torch.randn(*picture.shape, generator=generator).numpy()
        picture = np.clip(picture + float(grain[number]) * noise, 0, 1)
        if coded[number]:
            low, right = -picture.shape[0] % 8, -picture.shape[1] % 8
            padded = cv2.copyMakeBorder(picture, 0, low, 0, right, cv2.BORDER_REPLICATE)
            flags = [cv2.IMWRITE_JPEG_QUALITY, int(quality[number])]
            code = cv2.imencode(".jpg", (255 * padded).round().astype(np.uint8), flags)[1]
            decoded = cv2.imdecode(code, cv2.IMREAD_COLOR)
            assert decoded is not None
            picture = decoded[: picture.shape[0], : picture.shape[1]] / np.float32(255)
        if sharp[number]:  # cameras sharpen
            picture = np.clip(1.6 * picture - 0.6 * cv2.GaussianBlur(picture, (0, 0), 1.0), 0, 1)
        if far[number]:
            picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_LINEAR)
        pictures[number] = picture
    return torch.from_numpy(pictures).permute(0, 3, 1, 2)
