"""Weights over time that move as a face does: blinks, glances, speech, and expressions that come and go."""

import math

import torch
from torch import Tensor

from torchface.shape_names import ARKIT
from torchface.take import Take, Track

__all__ = ["perform"]

GESTURES: dict[str, dict[str, float]] = {
    "smile": {"mouthSmileLeft": 0.85, "mouthSmileRight": 0.8, "cheekSquintLeft": 0.5, "cheekSquintRight": 0.5},
    "crooked smile": {"mouthSmileLeft": 0.7, "mouthDimpleLeft": 0.5, "mouthLeft": 0.25},
    "surprise": {"browInnerUp": 0.9, "browOuterUpLeft": 0.7, "browOuterUpRight": 0.7, "eyeWideLeft": 0.7}
    | {"eyeWideRight": 0.7, "jawOpen": 0.35},
    "anger": {"browDownLeft": 0.9, "browDownRight": 0.85, "noseSneerLeft": 0.5, "noseSneerRight": 0.5}
    | {"mouthPressLeft": 0.6, "mouthPressRight": 0.6, "eyeSquintLeft": 0.5, "eyeSquintRight": 0.5},
    "sadness": {"browInnerUp": 0.7, "mouthFrownLeft": 0.8, "mouthFrownRight": 0.75, "mouthShrugLower": 0.5},
    "disgust": {"noseSneerLeft": 0.9, "noseSneerRight": 0.8, "mouthUpperUpLeft": 0.7, "mouthUpperUpRight": 0.6}
    | {"mouthLowerDownLeft": 0.3, "mouthLowerDownRight": 0.3},
    "puff": {"cheekPuff": 0.9, "mouthPressLeft": 0.4, "mouthPressRight": 0.4},
    "kiss": {"mouthPucker": 0.9, "mouthFunnel": 0.2},
    "chew": {"jawLeft": 0.6, "jawOpen": 0.25, "mouthClose": 0.2, "mouthRollUpper": 0.3},
    "thrust": {"jawForward": 0.8, "mouthShrugUpper": 0.4, "mouthRollLower": 0.3},
    "aside": {"mouthRight": 0.7, "jawRight": 0.4, "mouthStretchRight": 0.4},
    "grimace": {"mouthStretchLeft": 0.8, "mouthStretchRight": 0.8, "jawOpen": 0.2, "mouthDimpleRight": 0.4},
}
"""Expressions as an actor would be asked for them, in ARKit's shapes."""


def perform(frames: int, generator: torch.Generator, fps: float = 60.0) -> Take:
    """A take of synthetic weights: names are ARKit's 52, values (T,52,1) in [0,1].

    Gestures follow each other with raised-cosine ramps, held and overlapping; speech moves jaw and lips at syllable
    rate in between; blinks take 80 ms to close and 160 ms to open; glances jump and rest.

    Args:
        frames: how many, T.
        generator: where the randomness comes from.
        fps: frames a second.

    Example:
        >>> take = perform(120, torch.Generator().manual_seed(0))
        >>> len(take.weights.names), bool((take.weights.values >= 0).all() and (take.weights.values <= 1).all())
        (52, True)
    """
    row = {name: i for i, name in enumerate(ARKIT)}
    weights = torch.zeros(frames, len(ARKIT))
    seconds = torch.arange(frames) / fps
    duration = frames / fps

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    start, order = 0.3, torch.randperm(len(GESTURES), generator=generator).tolist()
    kinds = list(GESTURES.values())
    count = 0
    while start < duration:  # an event at a time: each draws its own timing
        rise, hold, fall, strength = uniform(0.15, 0.5), uniform(0.1, 0.9), uniform(0.25, 0.7), uniform(0.5, 1.0)
        envelope = strength * raised_cosine(seconds, start, rise, hold, fall)
        for name, weight in kinds[order[count % len(order)]].items():
            weights[:, row[name]] = torch.maximum(weights[:, row[name]], weight * uniform(0.8, 1.0) * envelope)
        start += rise + hold + uniform(0.0, 0.6)
        count += 1
    speech = _speech(seconds, generator)
    for name, curve in speech.items():
        weights[:, row[name]] = torch.maximum(weights[:, row[name]], curve)
    start = uniform(0.2, 1.5)
    while start < duration:
        blink = raised_cosine(seconds, start, 0.08, 0.02, 0.16)
        for side in ("Left", "Right"):
            weights[:, row[f"eyeBlink{side}"]] = torch.maximum(weights[:, row[f"eyeBlink{side}"]], blink)
        start += uniform(1.5, 4.5)
    _glance(weights, row, seconds, duration, uniform)
    return Take(fps, weights=Track(ARKIT, weights.clamp(0, 1)[..., None]))


def raised_cosine(seconds: Tensor, start: float, rise: float, hold: float, fall: float) -> Tensor:
    """A curve (T,) that rises from 0 to 1 from ``start`` on, stays there, and falls again, smoothly."""
    up = ((seconds - start) / rise).clamp(0, 1)
    down = ((seconds - start - rise - hold) / fall).clamp(0, 1)
    return 0.5 * (1 - torch.cos(math.pi * up)) * 0.5 * (1 + torch.cos(math.pi * down))


def _speech(seconds: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    """Band-limited curves at 1 to 5 Hz, switched on in phrases of about two seconds."""

    def band(low: float, high: float) -> Tensor:
        rate = low + (high - low) * torch.rand(6, generator=generator)
        phase = 2 * math.pi * torch.rand(6, generator=generator)
        return (torch.sin(2 * math.pi * rate * seconds[:, None] + phase).sum(1) / 3).clamp(0, 1)

    phrase = band(0.1, 0.4) ** 0.5
    jaw = 0.45 * phrase * band(1.5, 5.0)
    return {
        "jawOpen": jaw,
        "mouthClose": 0.5 * jaw * band(1.0, 3.0),
        "mouthFunnel": 0.4 * phrase * band(1.0, 3.0),
        "mouthPucker": 0.3 * phrase * band(1.0, 3.0),
        "mouthLowerDownLeft": 0.35 * phrase * band(1.5, 4.0),
        "mouthLowerDownRight": 0.35 * phrase * band(1.5, 4.0),
        "mouthUpperUpLeft": 0.25 * phrase * band(1.5, 4.0),
        "mouthUpperUpRight": 0.25 * phrase * band(1.5, 4.0),
        "mouthRollLower": 0.3 * phrase * band(0.8, 2.5),
        "mouthShrugUpper": 0.2 * phrase * band(0.8, 2.5),
    }


def _glance(weights: Tensor, row: dict[str, int], seconds: Tensor, duration: float, uniform) -> None:  # type: ignore[no-untyped-def]
    """Both eyes jump to a new direction in 60 ms and rest there; the subject's left is the viewer's right."""
    start, x, y = uniform(0.3, 1.0), 0.0, 0.0
    across, up = torch.zeros_like(seconds), torch.zeros_like(seconds)
    while start < duration:
        to_x, to_y = uniform(-0.6, 0.6), uniform(-0.4, 0.4)
        step = ((seconds - start) / 0.06).clamp(0, 1)
        across, up = across + (to_x - x) * step, up + (to_y - y) * step
        x, y = to_x, to_y
        start += uniform(0.4, 2.0)
    for side, inward in (("Left", -across), ("Right", across)):
        weights[:, row[f"eyeLookIn{side}"]] = inward.clamp(min=0)
        weights[:, row[f"eyeLookOut{side}"]] = (-inward).clamp(min=0)
        weights[:, row[f"eyeLookUp{side}"]] = up.clamp(min=0)
        weights[:, row[f"eyeLookDown{side}"]] = (-up).clamp(min=0)
