"""Live Link Face's packets: bytes as the app lays them out."""

import struct

import pytest
import torch

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.io.protocols.live_link_packets import LiveLinkPackets, read_live_link
from torchface.shape_names import ARKIT


def test_bytes_lie_where_other_receivers_look_for_them() -> None:
    packets = LiveLinkPackets(ARKIT, 60000 / 1001, "iPhone")
    packets(torch.zeros(52), None)
    (packet,) = packets(torch.arange(52) / 64, torch.arange(9) / 8)
    assert packet[:5] == b"\x06\x00\x00\x00\x24"
    assert [len(part) for part in packet[5:41].split(b"-")] == [8, 4, 4, 4, 12]
    assert struct.unpack_from("!i", packet, 41) == (6,)
    assert packet[45:51] == b"iPhone"
    assert struct.unpack_from("!if2ib", packet, 51) == (1, 0.0, 59940, 1000, 61)
    assert struct.unpack_from("!61f", packet, 68) == (*(i / 64 for i in range(52)), *(i / 8 for i in range(9)))
    assert len(packet) == 68 + 61 * 4
    assert read_live_link(packet)[0].sent == pytest.approx(1 / 59.94)
    later = packet[:51] + struct.pack("!if2i", 1200, 1.5, 30, 1) + packet[67:]
    assert read_live_link(later)[0].sent == pytest.approx(1201.5 / 30)


def test_what_no_packet_can_carry_is_refused() -> None:
    with pytest.raises(NameMismatchError, match="expected some of ARKit's"):
        LiveLinkPackets(["wing"], 60.0)
    packets = LiveLinkPackets(ARKIT, 60.0)
    for weights, rotations in ((torch.zeros(51), None), (torch.zeros(52), torch.zeros(3))):
        with pytest.raises(ShapeError, match=r"stream: found (weights|rotations) .*, expected"):
            packets(weights, rotations)


@pytest.mark.parametrize("fps", [0.0, -1.0, 1e9, 1e-9, float("nan"), float("inf")])
def test_a_rate_that_no_camera_has_is_refused(fps: float) -> None:
    with pytest.raises(ValueRangeError, match=r"stream: found .* frames a second"):
        LiveLinkPackets(ARKIT, fps)
