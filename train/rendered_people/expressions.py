"""Weights of ARKit's shapes for pictures: lids from wide to closed, mouths from pressed to wide, glances, gestures."""

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from torchface.shape_names import ARKIT
from torchface.synthetic.stages.weight_curves import GESTURES

from ..people_performances import converse
from .backdrops import uniform

Between = Callable[[float, float], float]
"""A number drawn between two others."""
Chance = Callable[[float], bool]
"""Whether something of a probability happens."""
Add = Callable[[str, float], None]
"""Raises a shape to a weight."""


class Both(Protocol):
    """Raises a shape's two sides to about a weight."""

    def __call__(self, name: str, weight: float, uneven: float = 0.15) -> None: ...


_SIDES = ("Left", "Right")
_FRAMES, _FRAME_RATE = 24, 8.0


def draw_expression(generator: torch.Generator) -> Tensor:
    """Weights (52,) in ARKit's order, in [0,1]."""
    table = dict.fromkeys(ARKIT, 0.0)

    def between(low: float, high: float) -> float:
        return uniform(low, high, generator)

    def chance(share: float) -> bool:
        return uniform(0, 1, generator) < share

    def add(name: str, weight: float) -> None:
        table[name] = min(1.0, max(table[name], weight))

    def both(name: str, weight: float, uneven: float = 0.15) -> None:
        for side in _SIDES:
            add(f"{name}{side}", max(0.0, weight + uneven * between(-1, 1)))

    if chance(0.35):
        strength = between(0.3, 1.0)
        for name, weight in list(GESTURES.values())[int(between(0, len(GESTURES) - 1e-6))].items():
            add(name, strength * weight)
    _mouth(between, chance, add, both)
    brows = between(0, 1)
    if brows < 0.22:
        both("browDown", between(0.2, 1))
    elif brows < 0.42:
        both("browOuterUp", between(0.1, 1), 0.3)
        add("browInnerUp", between(0, 1))
    elif brows < 0.55:
        add("browInnerUp", between(0.3, 1))
    if chance(0.12):
        both("noseSneer", between(0.2, 0.9), 0.3)
    if chance(0.2):
        both("cheekSquint", between(0.2, 0.9))
    for _ in range(int(between(0, 3.5))):
        add(ARKIT[int(between(0, len(ARKIT) - 1e-6))], between(0, 0.6))
    _lids(table, between, chance, both)
    across, up = between(-0.8, 0.8), between(-0.9, 0.7)
    add("eyeLookInLeft" if across < 0 else "eyeLookOutLeft", abs(across))
    add("eyeLookOutRight" if across < 0 else "eyeLookInRight", abs(across))
    both("eyeLookUp" if up > 0 else "eyeLookDown", abs(up) * (0.0 if max(table["eyeBlinkLeft"], 0) > 0.8 else 1.0), 0.0)
    return torch.tensor([table[name] for name in ARKIT])


def people_expression(generator: torch.Generator) -> Tensor:
    """Weights (52,) in ARKit's order of a moment of a performance; half of the times the liveliest of three."""
    take = converse(_FRAMES, generator, _FRAME_RATE).weights
    assert take is not None
    moments = take.values[torch.randint(_FRAMES, (3,), generator=generator), :, 0]
    liveliest = int(moments.square().sum(1).argmax())
    return moments[liveliest if uniform(0, 1, generator) < 0.5 else 0].float()


def _mouth(between: Between, chance: Chance, add: Add, both: Both) -> None:
    """One of the things mouths do, and how far the jaw is open with it."""
    kind = between(0, 1)
    if kind < 0.18:  # a smile, with or without teeth
        both("mouthSmile", between(0.2, 1.0), 0.2)
        both("cheekSquint", between(0, 0.7))
        if chance(0.6):
            both("mouthUpperUp", between(0.1, 0.7))
            both("mouthLowerDown", between(0.1, 0.7))
            both("mouthStretch", between(0.0, 0.5))
        add("jawOpen", between(0, 0.35) if chance(0.5) else 0.0)
    elif kind < 0.38:  # open
        add("jawOpen", between(0.05, 1.0))
        if chance(0.4):
            both("mouthStretch", between(0, 0.8))
            both("mouthLowerDown", between(0, 0.8))
            both("mouthUpperUp", between(0, 0.6))
        if chance(0.2):
            add("mouthFunnel", between(0.2, 1.0))
    elif kind < 0.48:  # speech
        add("jawOpen", between(0, 0.35))
        add(
            ("mouthFunnel", "mouthPucker", "mouthRollLower", "mouthRollUpper")[int(between(0, 3.99))], between(0.1, 0.9)
        )
        both("mouthUpperUp", between(0, 0.4))
        both("mouthLowerDown", between(0, 0.5))
    elif kind < 0.58:  # pressed or rolled in
        both("mouthPress", between(0.2, 1.0))
        add("mouthRollUpper", between(0, 0.9))
        add("mouthRollLower", between(0, 0.9))
    elif kind < 0.64:
        add("mouthPucker", between(0.3, 1.0))
    elif kind < 0.72:
        both("mouthFrown", between(0.2, 1.0))
        add("mouthShrugLower", between(0, 0.9))
    elif kind < 0.77:
        side = "Left" if chance(0.5) else "Right"
        add(f"mouth{side}", between(0.2, 0.9))
        add(f"jaw{side}", between(0, 0.7))


def _lids(table: dict[str, float], between: Between, chance: Chance, both: Both) -> None:
    """Closed, half closed, one closed, squinting, wide, or as they are."""
    kind = between(0, 1)
    if kind < 0.22:
        both("eyeBlink", 1.0, 0.0)
    elif kind < 0.42:
        both("eyeBlink", between(0.1, 0.95), 0.05)
    elif kind < 0.46:
        table[f"eyeBlink{'Left' if chance(0.5) else 'Right'}"] = between(0.5, 1.0)
    elif kind < 0.6:
        both("eyeSquint", between(0.2, 1.0))
    elif kind < 0.7:
        both("eyeWide", between(0.2, 1.0))
    if kind < 0.22 and chance(0.4):  # screwed up
        both("eyeSquint", between(0.2, 1.0))
