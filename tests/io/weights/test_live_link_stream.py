"""Live Link Face packets: bytes as the app lays them out, back again, and no crash on damaged ones."""

from __future__ import annotations

import errno
import socket
import struct

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchface.errors import FileFormatError, NameMismatchError, TorchfaceError, ValueRangeError
from torchface.io.weights.live_link_stream import (
    LiveLinkFrame,
    LiveLinkSender,
    decode_frame,
    encode_frame,
)
from torchface.io.weights.udp_sending import parse_address
from torchface.shape_names import ARKIT

DEVICE = "0B57A4B6-6D4C-4C1F-9F24-0D0D6A3F6D11"


def a_frame() -> LiveLinkFrame:
    return LiveLinkFrame(DEVICE, "iPhone", 4711, 0.25, (60000, 1001), torch.arange(52) / 64, torch.arange(9) / 8)


def test_bytes_lie_where_other_receivers_look_for_them() -> None:
    packet = encode_frame(a_frame())
    assert packet[:5] == b"\x06\x00\x00\x00\x24"
    assert packet[5:41] == DEVICE.encode()
    assert struct.unpack_from("!i", packet, 41) == (6,)
    assert packet[45:51] == b"iPhone"
    assert struct.unpack_from("!if2ib", packet, 51) == (4711, 0.25, 60000, 1001, 61)
    assert struct.unpack_from("!61f", packet, 68) == (*(i / 64 for i in range(52)), *(i / 8 for i in range(9)))
    assert len(packet) == 68 + 61 * 4


def test_a_packet_comes_back() -> None:
    sent, got = a_frame(), decode_frame(encode_frame(a_frame()))
    assert (got.device, got.subject, got.frame, got.subframe, got.rate) == (DEVICE, "iPhone", 4711, 0.25, (60000, 1001))
    assert torch.equal(got.weights, sent.weights)
    assert torch.equal(got.rotations, sent.rotations)


@given(st.data())
def test_damaged_packets_are_refused_or_read(data: st.DataObject) -> None:
    packet = bytearray(encode_frame(a_frame()))
    for _ in range(data.draw(st.integers(1, 4))):
        packet[data.draw(st.integers(0, len(packet) - 1))] = data.draw(st.integers(0, 255))
    packet = packet[: data.draw(st.integers(0, len(packet)))]
    try:
        frame = decode_frame(bytes(packet))
    except TorchfaceError:
        return
    assert torch.isfinite(frame.weights).all()


def test_sent_frames_arrive_by_arkit_names() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        names = ["browInnerUp_L", "browInnerUp_R", "jawOpen"]
        with LiveLinkSender(f"udp://127.0.0.1:{receiver.getsockname()[1]}", names, 60.0) as sender:
            sender.send(torch.tensor([0.2, 0.6, 0.5]))
            sender.send(torch.tensor([0.0, 0.0, float("nan")]))
            first, second = (decode_frame(receiver.recv(2048)) for _ in range(2))
    assert first.weights[ARKIT.index("browInnerUp")] == pytest.approx(0.4)
    assert first.weights[ARKIT.index("jawOpen")] == 0.5
    assert (first.frame, second.frame, first.rate) == (0, 1, (60000, 1000))
    assert not second.weights.any()


@pytest.mark.parametrize("address", ["127.0.0.1:11111", "udp://127.0.0.1", "udp://h:70000", "tcp://h:1", "udp://:5"])
def test_addresses_that_are_none(address: str) -> None:
    with pytest.raises(ValueRangeError, match="expected an address such as udp://"):
        parse_address(address)


def test_names_that_arkit_lacks() -> None:
    with pytest.raises(NameMismatchError, match="expected some of ARKit's"):
        LiveLinkSender("udp://127.0.0.1:11111", ["wing"], 60.0)


def test_nan_is_not_encoded() -> None:
    with pytest.raises(ValueRangeError, match="NaN"):
        encode_frame(LiveLinkFrame(DEVICE, "x", 0, 0.0, (60, 1), torch.full((52,), torch.nan)))


def test_another_version_is_named() -> None:
    with pytest.raises(FileFormatError, match="found version 07, expected 06"):
        decode_frame(b"\x07" + encode_frame(a_frame())[1:])


HOSTS = ("a..b", "x" * 300, "x" * 64 + ".org", "\x00", "-", "1.2.3.4.5", "\u00e9", ".", "[::1::]", "no-such.invalid")


@pytest.mark.parametrize("host", HOSTS)
def test_hosts_that_cannot_be_are_refused(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def resolver(name: str, *_: object, **__: object) -> list[object]:
        name.encode("idna")  # as the real one does, without a network
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", resolver)
    with pytest.raises(ValueRangeError, match=r"^stream: found 'udp://"):
        LiveLinkSender(f"udp://{host}:11111", ARKIT, 60.0)


@pytest.mark.parametrize("fps", [0.0, -1.0, 1e9, 1e-9, float("nan"), float("inf")])
def test_a_rate_that_no_camera_has_is_refused(fps: float) -> None:
    with pytest.raises(ValueRangeError, match=r"stream: found .* frames a second"):
        LiveLinkSender("udp://127.0.0.1:11111", ARKIT, fps)


def test_broadcast_is_allowed_and_what_cannot_be_sent_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with LiveLinkSender("udp://255.255.255.255:9", ARKIT, 60.0) as sender:
        own = sender._socket._socket
        assert own.getsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST) != 0

        class Cut:
            def send(self, *_: object) -> None:
                raise OSError(errno.ENETUNREACH, "Network is unreachable")

            def close(self) -> None:
                own.close()

        monkeypatch.setattr(sender._socket, "_socket", Cut())
        with pytest.raises(ValueRangeError, match=r"cannot send to udp://255.* \(Network is unreachable\)"):
            sender.send(torch.zeros(52))
