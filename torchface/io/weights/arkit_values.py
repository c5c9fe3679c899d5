"""Values as programs for iPhones write them: ARKit's names in several spellings, angles in degrees, numbers as text."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.shape_names import ARKIT

_ROWS = {name.lower(): row for row, name in enumerate(ARKIT)}
_ROWS |= {name.lower().replace("left", "_l").replace("right", "_r"): row for name, row in list(_ROWS.items())}
_MAX_TEXT = 40


def arkit_row(name: str) -> int | None:
    """Which of ARKit's 52 a name is, however it is spelled (``EyeBlinkLeft``, ``eyeBlink_L``); None for others."""
    return _ROWS.get(name.lower())


def finite_number(text: str, where: str) -> float:
    """The number that a text stands for."""
    try:
        value = float(text) if len(text) <= _MAX_TEXT else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FileFormatError(f"{where}: found {text!r:.60}, expected a number")
    return value


def rotations_of_degrees(head: Sequence[float], left: Sequence[float], right: Sequence[float]) -> Tensor:
    """Live Link Face's nine rotations (9,), radians, of degrees about ARKit's axes x, y, z.

    ARKit's y turns to the person's left, as the head's yaw does; the yaw of eyes turns to the right.
    """
    angles = [head[1], head[0], head[2], -left[1], left[0], 0.0, -right[1], right[0], 0.0]
    return torch.tensor(angles) * (math.pi / 180)


def degrees_of_rotations(rotations: Tensor) -> tuple[list[float], list[float], list[float]]:
    """Of rotations (9,) the degrees about ARKit's x, y, z of the head, the left and the right eye."""
    yaw, pitch, roll, left_yaw, left_pitch, _, right_yaw, right_pitch, _ = (rotations * (180 / math.pi)).tolist()
    return [pitch, yaw, roll], [left_pitch, -left_yaw, 0.0], [right_pitch, -right_yaw, 0.0]
