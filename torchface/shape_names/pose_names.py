"""Names that stand for several of ARKit's shapes at once: action units, and MikuMikuDance's morphs."""

import re
from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.shape_names.arkit_names import ARKIT
from torchface.shape_names.name_tables import VRM1

_UNIT = re.compile(r"AU[_ ]?0?(\d\d?)(_r)?(?:[_ ]?(L|R|Left|Right))?")
_UNITS = {
    "1": ("browInnerUp",),
    "2": ("browOuterUp",),
    "4": ("browDown",),
    "5": ("eyeWide",),
    "6": ("cheekSquint",),
    "7": ("eyeSquint",),
    "9": ("noseSneer",),
    "10": ("mouthUpperUp",),
    "12": ("mouthSmile",),
    "14": ("mouthDimple",),
    "15": ("mouthFrown",),
    "16": ("mouthLowerDown",),
    "17": ("mouthShrugLower",),
    "18": ("mouthPucker",),
    "20": ("mouthStretch",),
    "22": ("mouthFunnel",),
    "24": ("mouthPress",),
    "26": ("jawOpen",),
    "27": ("jawOpen",),
    "28": ("mouthRollUpper", "mouthRollLower"),
    "29": ("jawForward",),
    "34": ("cheekPuff",),
    "43": ("eyeBlink",),
    "45": ("eyeBlink",),
}
"""ARKit's shapes of which each is one action unit's motion. Lips that tighten (23) or part (25), and units that say no
side where ARKit has two (30, 33, 61), have none. Source: Ekman, Friesen, Hager, Facial Action Coding System, 2002."""

_CLIPS = {
    **dict(zip("あいうえお", ("aa", "ih", "ou", "ee", "oh"), strict=True)),
    **{"まばたき": "blink", "笑い": "blink", "ウィンク": "blinkLeft", "ウィンク右": "blinkRight"},
    **{"ウィンク２": "blinkLeft", "ｳｨﾝｸ２右": "blinkRight"},
}
_BROWS = {"怒り": "browDown", "下": "browDown", "上": "browOuterUp", "困る": "browInnerUp", "びっくり": "eyeWide"}
"""Morphs of MikuMikuDance's standard characters; vowels are VRM's clips."""


def is_action_unit(name: str) -> bool:
    """Whether a name is an action unit's: ``AU12``, OpenFace's intensity ``AU12_r``, a side's ``AU12L``."""
    return _UNIT.fullmatch(name) is not None


def posed_weights(names: Sequence[str]) -> Tensor:
    """ARKit's weights (52,N) of action units and of MikuMikuDance's morphs; 0 for other names.

    Example:
        >>> posed_weights(["AU12_r", "AU26", "まばたき"])[ARKIT.index("jawOpen")].tolist()
        [0.0, 1.0, 0.0]
    """
    weights = torch.zeros(len(ARKIT), len(names))
    for column, name in enumerate(names):
        for shape, weight in _pose(name).items():
            sides = [shape] if shape in ARKIT else [f"{shape}Left", f"{shape}Right"]
            weights[[ARKIT.index(side) for side in sides if side in ARKIT], column] = weight
    return weights


def _pose(name: str) -> dict[str, float]:
    """What a name stands for in ARKit's shapes, those without a side on both."""
    unit = _UNIT.fullmatch(name)
    if unit is not None:
        side = {"L": "Left", "R": "Right"}.get((unit[3] or "")[:1], "")
        shapes = _UNITS.get(unit[1], ())
        half = 0.5 if side else 1.0  # a side of what is one shape in ARKit
        return {**{s: half for s in shapes if s in ARKIT}, **{s + side: 1.0 for s in shapes if s not in ARKIT}}
    if name in _CLIPS:
        return dict(VRM1.poses[_CLIPS[name]])
    return {_BROWS[name]: 1.0} if name in _BROWS else {}
