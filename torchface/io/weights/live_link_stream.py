"""Live Link Face's packets: frames of weights over UDP, as the iPhone app sends them to Unreal."""

from __future__ import annotations

import math
import struct
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import TracebackType

import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.io.weights.arkit_weights import ArkitWeights
from torchface.io.weights.udp_sending import UdpSocket
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.number_checks import check_rate
from torchface.shape_names import ARKIT

VALUES = len(ARKIT) + len(ROTATIONS)
"""How many numbers a packet carries: ARKit's 52 weights and nine rotations."""

_VERSION = 6
_MAX_TEXT_BYTES = 256
_TIME = struct.Struct("!ifii")
_NUMBERS = struct.Struct(f"!{VALUES}f")


@dataclass(frozen=True, eq=False)
class LiveLinkFrame:
    """One packet.

    Args:
        device: the sender's identifier, text.
        subject: the name under which Unreal lists the face.
        frame: frames since midnight, or since the take began.
        subframe: in [0,1).
        rate: frames a second as (numerator, denominator).
        weights: ARKit's 52 in the app's order, (52,).
        rotations: head, left eye, right eye, each yaw, pitch, roll, radians, (9,).
    """

    device: str
    subject: str
    frame: int
    subframe: float
    rate: tuple[int, int]
    weights: Tensor
    rotations: Tensor = field(default_factory=lambda: torch.zeros(len(ROTATIONS)))


def encode_frame(frame: LiveLinkFrame) -> bytes:
    """The packet that the app would send.

    Raises:
        ShapeError: not 52 weights and 9 rotations.
        ValueRangeError: a number is not finite or a text is too long.

    Example:
        >>> half = torch.full((52,), 0.5)
        >>> packet = encode_frame(LiveLinkFrame("iPhone", "actor", frame=1, subframe=0.0, rate=(60, 1), weights=half))
        >>> decode_frame(packet).subject
        'actor'
    """
    if frame.weights.shape != (len(ARKIT),) or frame.rotations.shape != (len(ROTATIONS),):
        raise ShapeError(
            f"live link frame: found weights {tuple(frame.weights.shape)} and rotations "
            f"{tuple(frame.rotations.shape)}, expected ({len(ARKIT)},) and ({len(ROTATIONS)},)"
        )
    numbers = torch.cat([frame.weights, frame.rotations]).tolist()
    if not all(map(math.isfinite, numbers)):
        raise ValueRangeError("live link frame: found NaN or infinity, expected numbers")
    head = bytes([_VERSION]) + _text(frame.device, "device") + _text(frame.subject, "subject")
    time = _TIME.pack(frame.frame, frame.subframe, *frame.rate)
    return head + time + bytes([VALUES]) + _NUMBERS.pack(*numbers)


def decode_frame(packet: bytes) -> LiveLinkFrame:
    """What a packet says.

    Raises:
        FileFormatError: it is no such packet, is cut short, or too long.

    Example:
        >>> still = LiveLinkFrame("iPhone", "actor", frame=7, subframe=0.0, rate=(60, 1), weights=torch.zeros(52))
        >>> decode_frame(encode_frame(still)).frame
        7
    """
    if packet[:1] != bytes([_VERSION]):
        raise FileFormatError(f"live link packet: found version {packet[:1].hex() or 'none'}, expected {_VERSION:02x}")
    device, rest = _split_text(packet[1:], "device")
    subject, rest = _split_text(rest, "subject")
    if len(rest) != _TIME.size + 1 + _NUMBERS.size or rest[_TIME.size] != VALUES:
        raise FileFormatError(
            f"live link packet: found {len(rest)} bytes behind the subject, expected a time and {VALUES} numbers"
        )
    number, subframe, numerator, denominator = _TIME.unpack_from(rest)
    values = torch.tensor(_NUMBERS.unpack_from(rest, _TIME.size + 1))
    if not torch.isfinite(values).all() or numerator <= 0 or denominator <= 0:
        raise FileFormatError("live link packet: found NaN, infinity or a rate that is not positive")
    weights, rotations = values.split([len(ARKIT), len(ROTATIONS)])
    return LiveLinkFrame(device, subject, number, subframe, (numerator, denominator), weights, rotations)


class LiveLinkSender:
    """Sends weights as Live Link Face's packets.

    Args:
        address: ``udp://HOST:PORT`` or ``livelink://HOST:PORT``; Unreal listens on port 11111. A broadcast address
            reaches a whole network.
        names: of the weights that come, (N,); any rig's names that ARKit's can be had from.
        fps: frames a second.
        subject: the name under which the receiver lists the face.

    Raises:
        ValueRangeError: the address is none, its host is not known, or ``fps`` is no camera's.
        NameMismatchError: not one name is one of ARKit's.
    """

    def __init__(self, address: str, names: Sequence[str], fps: float, subject: str = "torchface") -> None:
        check_rate(fps, "stream", ValueRangeError)
        self._arkit = ArkitWeights(names)
        self._socket = UdpSocket(address)
        self._device = str(uuid.uuid4()).upper()
        self._subject, self._fps, self._sent = subject, fps, 0

    def send(self, weights: Tensor, rotations: Tensor | None = None) -> bool:
        """Sends one frame: weights (N,), rotations (9,) in radians; NaN is sent as 0.

        Returns:
            Whether nothing told that a frame before was refused.

        Raises:
            ShapeError: another number of weights than names.
            ValueRangeError: this machine cannot send there.
        """
        rotations = torch.zeros(len(ROTATIONS)) if rotations is None else rotations.float().nan_to_num(0.0)
        frame = LiveLinkFrame(
            self._device,
            self._subject,
            self._sent,
            0.0,
            (round(self._fps * 1000), 1000),
            self._arkit(weights),
            rotations,
        )
        welcome = self._socket.send(encode_frame(frame))
        self._sent += 1
        return welcome

    def close(self) -> None:
        """Gives the socket back."""
        self._socket.close()

    def __enter__(self) -> LiveLinkSender:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _text(text: str, what: str) -> bytes:
    data = text.encode()
    if len(data) > _MAX_TEXT_BYTES:
        raise ValueRangeError(
            f"live link frame: found a {what} of {len(data)} bytes, expected at most {_MAX_TEXT_BYTES}"
        )
    return struct.pack("!i", len(data)) + data


def _split_text(data: bytes, what: str) -> tuple[str, bytes]:
    length = int.from_bytes(data[:4], "big", signed=True)
    if len(data) < 4 or not 0 <= length <= min(_MAX_TEXT_BYTES, len(data) - 4):
        raise FileFormatError(f"live link packet: found a {what} of {length} bytes in {len(data)}, expected it whole")
    try:
        return data[4 : 4 + length].decode(), data[4 + length :]
    except UnicodeDecodeError as error:
        raise FileFormatError(f"live link packet: the {what} is no text") from error
