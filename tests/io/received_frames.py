"""Live Link Face's packets read back, as Unreal reads them."""

import struct
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class ReceivedFrame:
    """A packet's texts, its frame's number and rate, ARKit's weights (52,) and rotations (9,)."""

    device: str
    subject: str
    frame: int
    rate: tuple[int, int]
    weights: Tensor
    rotations: Tensor


def decode_frame(packet: bytes) -> ReceivedFrame:
    """What a packet says."""
    assert packet[0] == 6
    texts, at = [], 1
    for _ in range(2):
        (length,) = struct.unpack_from("!i", packet, at)
        texts.append(packet[at + 4 : at + 4 + length].decode())
        at += 4 + length
    frame, subframe, numerator, denominator, count = struct.unpack_from("!ifiiB", packet, at)
    assert (subframe, count) == (0, 61)
    values = torch.tensor(struct.unpack_from("!61f", packet, at + 17))
    assert len(packet) == at + 17 + 61 * 4
    return ReceivedFrame(texts[0], texts[1], frame, (numerator, denominator), values[:52], values[52:])
