"""A face as one packet or one frame of a file gives it, its numbers checked."""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.io.weights.weight_csv import ROTATIONS

_MOST, _MOST_ANGLE = 5.0, 2 * math.pi  # no program sends larger weights, 1 being all, or angles in radians


@dataclass(frozen=True, eq=False)
class ReceivedFace:
    """What a packet says of a face."""

    weights: Tensor  # by ARKit's names, (52,)
    # Live Link Face's nine of head and eyes, radians, (9,).
    rotations: Tensor = field(default_factory=lambda: torch.zeros(len(ROTATIONS)))
    subject: str = ""  # how the sender calls the face or itself
    number: int | None = None  # of the frame as the sender counts; None where it does not
    found: bool = True  # whether the sender sees a face
    sent: float = math.nan  # when, by the sender's clock in seconds, where it has one

    def __post_init__(self) -> None:
        for what, values, most in (("weight", self.weights, _MOST), ("rotation", self.rotations, _MOST_ANGLE)):
            if not bool((values.abs() <= most).all()):  # NaN is not either
                worst = values[~(values.abs() <= most)][0].item()
                raise FileFormatError(f"packet: found a {what} of {worst:g}, expected at most {most:.2f}")
