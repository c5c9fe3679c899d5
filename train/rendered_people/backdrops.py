"""Backdrops of a face in an image, and a camera's effects: structure, blur, noise, compression."""

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.rendering.gaussian_blur import gaussian_blur


def uniform(low: float, high: float, generator: torch.Generator) -> float:
    """A number between two others."""
    return low + (high - low) * float(torch.rand((), generator=generator))


def backdrop(height: int, width: int, generator: torch.Generator) -> Tensor:
    """A grey image (H,W) in [0,1] with clouds, edges, stripes and spots of all sizes."""
    image = np.full((height, width), uniform(0.05, 0.95, generator), dtype=np.float32)
    for octave in range(1, 7):
        amount = uniform(0, 0.35, generator) * 0.75**octave
        coarse = torch.randn(2**octave + 1, 2**octave + 1, generator=generator).numpy()
        image += amount * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    for _ in range(int(uniform(0, 14, generator))):  # a shape at a time, each over those before
        x, y = uniform(-0.1, 1.1, generator) * width, uniform(-0.1, 1.1, generator) * height
        size, tilt = uniform(0.03, 0.5, generator) * width, uniform(0, 180, generator)
        grey, kind = uniform(0, 1, generator), uniform(0, 3, generator)
        if kind < 1:
            corners = cv2.boxPoints(((x, y), (size, size * uniform(0.1, 1.5, generator)), tilt))
            cv2.fillPoly(image, [corners.astype(np.int32)], grey)
        elif kind < 2:
            axes = (max(1, int(size / 2)), max(1, int(size * uniform(0.15, 0.7, generator))))
            cv2.ellipse(image, (int(x), int(y)), axes, tilt, 0, 360, grey, -1)
        else:
            reach = np.array([math.cos(math.radians(tilt)), math.sin(math.radians(tilt))]) * size * 2
            ends = (np.array([x, y]) - reach).astype(int), (np.array([x, y]) + reach).astype(int)
            cv2.line(image, tuple(map(int, ends[0])), tuple(map(int, ends[1])), grey, int(uniform(1, 7, generator)))
    sigma = uniform(0, 4, generator)
    blurred = gaussian_blur(torch.from_numpy(image)[None, None], sigma if sigma > 0.4 else 0)
    return blurred[0, 0].clamp(0, 1)


def photographed(image: Tensor, height: int, generator: torch.Generator) -> Tensor:
    """What a camera makes of a grey image (H,W) in [0,1]: uint8 (height, width), blurred, noisy, compressed."""
    high, wide = image.shape
    sigma = abs(uniform(-0.6, 1.2, generator)) * high / 200
    grey = gaussian_blur(image[None, None], sigma if sigma > 0.2 else 0)[0, 0].numpy()
    grey = cv2.resize(grey, (max(1, round(wide * height / high)), height), interpolation=cv2.INTER_AREA)
    grey = grey + uniform(0, 0.035, generator) * torch.randn(grey.shape, generator=generator).numpy()
    stored = np.clip(grey * 255, 0, 255).round().astype(np.uint8)
    if uniform(0, 1, generator) < 0.6:
        quality = int(uniform(35, 95, generator))
        stored = cv2.imdecode(cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 0)  # type: ignore[assignment]
    return torch.from_numpy(stored)
