"""Live Link Face's packets: frames of weights as the iPhone app sends them to Unreal."""

from __future__ import annotations

import struct
import uuid
from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.number_checks import check_rate
from torchface.shape_names import ARKIT, mapping

LIVE_LINK_PORT = 11111
_VERSION, _VALUES = 6, len(ARKIT) + len(ROTATIONS)
_TIME = struct.Struct("!ifii")  # frame, subframe, rate as a fraction
_NUMBERS = struct.Struct(f"!{_VALUES}f")


class ArkitWeights:
    """Turns weights by a rig's names into weights by ARKit's.

    Args:
        names: of the weights that come, (N,).
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._matrix = mapping(names, ARKIT).float()
        if not self._matrix.any():
            raise NameMismatchError(f"stream: found the shapes {', '.join(names[:5])}, expected some of ARKit's")

    def __call__(self, weights: Tensor) -> Tensor:
        """Weights (N,) as (52,), float32; NaN becomes 0.

        Raises:
            ShapeError: another number of weights than names.
        """
        if weights.shape != self._matrix.shape[1:]:
            raise ShapeError(f"stream: found weights {tuple(weights.shape)}, expected ({self._matrix.shape[1]},)")
        return self._matrix @ weights.detach().float().cpu().nan_to_num(0.0)


def rotations_sent(rotations: Tensor | None) -> Tensor:
    """Rotations (9,) float32, radians; 0 where there are none or NaN."""
    if rotations is None:
        return torch.zeros(len(ROTATIONS))
    if rotations.shape != (len(ROTATIONS),):
        raise ShapeError(f"stream: found rotations {tuple(rotations.shape)}, expected ({len(ROTATIONS)},)")
    return rotations.detach().float().cpu().nan_to_num(0.0)


class LiveLinkPackets:
    """Packets of frames, as the app would send them: ARKit's 52 weights and nine rotations each.

    Args:
        names: of the weights that come, (N,); any rig's names that ARKit's can be had from.
        fps: frames a second.
        subject: the name under which the receiver lists the face.

    Example:
        >>> (packet,) = LiveLinkPackets(["jawOpen"], fps=60.0)(torch.tensor([0.5]), None)
        >>> len(packet), packet[45:54]
        (315, b'torchface')
    """

    def __init__(self, names: Sequence[str], fps: float, subject: str = "torchface") -> None:
        check_rate(fps, "stream", ValueRangeError)
        self._arkit, self._rate, self._sent = ArkitWeights(names), (round(fps * 1000), 1000), 0
        texts = (str(uuid.uuid4()).upper().encode(), subject.encode())  # of the device and the subject
        self._head = bytes([_VERSION]) + b"".join(struct.pack("!i", len(text)) + text for text in texts)

    def __call__(self, weights: Tensor, rotations: Tensor | None) -> list[bytes]:
        """The packet of the next frame: weights (N,), rotations (9,) in radians; NaN is sent as 0.

        Raises:
            ShapeError: another number of weights than names, or of rotations than nine.
        """
        numbers = torch.cat([self._arkit(weights), rotations_sent(rotations)]).tolist()
        time = _TIME.pack(self._sent, 0.0, *self._rate)
        self._sent += 1
        return [self._head + time + bytes([_VALUES]) + _NUMBERS.pack(*numbers)]
