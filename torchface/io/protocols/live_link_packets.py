"""Live Link Face's packets: frames of weights as the iPhone app sends them to Unreal."""

import math
import struct
import uuid
from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io.protocols.received_face import ReceivedFace
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.number_checks import check_rate
from torchface.shape_names import ARKIT, mapping

LIVE_LINK_PORT = 11111
_VERSION, _VALUES = 6, len(ARKIT) + len(ROTATIONS)
_TIME = struct.Struct("!ifii")  # frame, subframe, rate as a fraction
_NUMBERS = struct.Struct(f"!{_VALUES}f")
_MOST_TEXT = 256  # bytes of a device's or a subject's name


class ArkitWeights:
    """Turns weights by a rig's names into weights by ARKit's."""

    def __init__(self, names: Sequence[str]) -> None:
        self._matrix = mapping(names, ARKIT).float()
        if not self._matrix.any():
            raise NameMismatchError(f"stream: found the shapes {', '.join(names[:5])}, expected some of ARKit's")

    def __call__(self, weights: Tensor) -> Tensor:
        """Weights (N,) as (52,), float32; NaN becomes 0."""
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
    """Packets of frames, as the app would send them, under a subject's name: ARKit's 52 weights and nine rotations
    each."""

    def __init__(self, names: Sequence[str], fps: float, subject: str = "torchface") -> None:
        check_rate(fps, "stream", ValueRangeError)
        self._arkit, self._rate, self._sent = ArkitWeights(names), (round(fps * 1000), 1000), 0
        texts = (str(uuid.uuid4()).upper().encode(), subject.encode())  # of the device and the subject
        self._head = bytes([_VERSION]) + b"".join(struct.pack("!i", len(text)) + text for text in texts)

    def __call__(self, weights: Tensor, rotations: Tensor | None) -> list[bytes]:
        """The packet of the next frame: weights (N,), rotations (9,) in radians; NaN is sent as 0."""
        numbers = torch.cat([self._arkit(weights), rotations_sent(rotations)]).tolist()
        time = _TIME.pack(self._sent, 0.0, *self._rate)
        self._sent += 1
        return [self._head + time + bytes([_VALUES]) + _NUMBERS.pack(*numbers)]


def read_live_link(packet: bytes) -> list[ReceivedFace]:
    """The face of a packet of the app; one without values is of a face that the app does not see."""
    if packet[:1] != bytes([_VERSION]):
        found = f"version {packet[0]}" if packet else "no byte"
        raise FileFormatError(f"packet: found {found}, expected Live Link Face's version {_VERSION}")
    texts, at = [], 1
    try:
        for _ in range(2):
            (length,) = struct.unpack_from("!i", packet, at)
            if not 0 <= length <= _MOST_TEXT or at + 4 + length > len(packet):
                raise FileFormatError(f"packet: found a name of {length} bytes, expected at most {_MOST_TEXT}")
            texts.append(packet[at + 4 : at + 4 + length].decode(errors="replace"))
            at += 4 + length
        number, part, rate, base = _TIME.unpack_from(packet, at)
        sent = (number + part) * base / rate if rate else math.nan
        at += _TIME.size
        count = packet[at] if at < len(packet) else 0
        if count == 0:
            return [ReceivedFace(torch.zeros(len(ARKIT)), subject=texts[1], number=number, found=False, sent=sent)]
        if count != _VALUES or len(packet) != at + 1 + _NUMBERS.size:
            raise FileFormatError(f"packet: found {count} values in {len(packet)} bytes, expected {_VALUES}")
        values = torch.tensor(_NUMBERS.unpack_from(packet, at + 1))
    except struct.error as error:
        raise FileFormatError(f"packet: found {len(packet)} bytes, expected a whole packet ({error})") from error
    return [ReceivedFace(values[: len(ARKIT)], values[len(ARKIT) :], texts[1], number, sent=sent)]


def packet_rate(packet: bytes) -> float:
    """Frames a second that a whole packet states."""
    at = 1
    for _ in range(2):
        at += 4 + int.from_bytes(packet[at : at + 4], "big")
    _, _, numerator, denominator = _TIME.unpack_from(packet, at)
    rate = numerator / denominator if denominator else 0.0
    check_rate(rate, "packet", FileFormatError)
    return rate
