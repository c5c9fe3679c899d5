"""Faces received by UDP: an iPhone's packets as they are, other programs', and what is wrong on the way."""

import gzip
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
import torch

from torchface.errors import ValueRangeError
from torchface.io.protocols.ifacialmocap_packets import START, IFacialMocapPackets
from torchface.io.protocols.live_link_packets import LiveLinkPackets
from torchface.io.protocols.live_link_recordings import recorded_packets
from torchface.io.protocols.osc_messages import osc_message
from torchface.io.protocols.osc_packets import OscPackets
from torchface.io.protocols.received_face import ReceivedFace
from torchface.io.protocols.vmc_packets import VmcPackets
from torchface.io.protocols.weight_receiver import FrameOrder, WeightReceiver
from torchface.shape_names import ARKIT

WEIGHTS, ROTATIONS = torch.arange(52) / 64, torch.arange(9) / 16


def played(receiver: WeightReceiver, packets: list[bytes]) -> list[ReceivedFace]:
    """What comes out of packets that are sent one by one from one port."""
    with udp() as sender:
        return sent(sender, receiver, packets)


def udp() -> socket.socket:
    return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)


def sent(sender: socket.socket, receiver: WeightReceiver, packets: list[bytes]) -> list[ReceivedFace]:
    """What comes out of packets that are sent one by one, once all of them have come."""
    faces, came = list[ReceivedFace](), receiver.counts.packets
    for packet in packets:
        sender.sendto(packet, ("127.0.0.1", receiver.port))
        faces += arrived(receiver, came := came + 1)
    return faces


def arrived(receiver: WeightReceiver, packets: int) -> list[ReceivedFace]:
    """The faces that have come when the receiver has counted so many packets: a busy machine delivers them late."""
    faces, end = [], time.perf_counter() + 10
    while receiver.counts.packets < packets and time.perf_counter() < end:
        faces += [face for _, face in receiver.faces(0.01)]
    assert receiver.counts.packets == packets
    return faces


@pytest.mark.real
@pytest.mark.parametrize("file", ["dao", "debug-jawopen", "debug-headyaw"])
def test_an_iphones_packets_are_received_as_they_are(file: str, data: Path) -> None:
    path = data / "protocols" / f"live_link_{file}.gesichter"
    packets = list(recorded_packets(path))
    raw = gzip.decompress(path.read_bytes())  # the numbers by their place in the bytes, without a reader of ours
    size = int.from_bytes(raw[5:9], "big")
    expected = [struct.unpack("!61f", raw[at + size - 240 : at + size + 4]) for at in range(5, len(raw), size + 4)]
    with WeightReceiver("livelink://127.0.0.1:0") as receiver:
        faces = played(receiver, packets)
        assert "LLV Default Device" in receiver.sender
        assert receiver.counts.malformed == 0
        gaps = 7 if file == "dao" else 0  # the recording lacks frames: eight numbers further after the sixth
        assert receiver.counts.lost >= gaps
    assert len(faces) == len(expected) == receiver.counts.taken
    found = torch.stack([torch.cat([face.weights, face.rotations]) for face in faces])
    torch.testing.assert_close(found, torch.tensor(expected), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("scheme", "packets"),
    [
        ("livelink", LiveLinkPackets(ARKIT, 60.0)(WEIGHTS, ROTATIONS)),
        ("ifacialmocap", IFacialMocapPackets(ARKIT)(WEIGHTS, ROTATIONS)),
        ("vmc", VmcPackets(ARKIT)(WEIGHTS, ROTATIONS)),
        ("osc", OscPackets(ARKIT)(WEIGHTS, ROTATIONS)),
    ],
)
def test_each_protocol_is_received_at_ipv4_and_ipv6(scheme: str, packets: list[bytes]) -> None:
    with WeightReceiver(f"{scheme}://:0") as receiver:
        assert len(played(receiver, packets)) == 1
        if socket.has_dualstack_ipv6():
            with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sender:
                for packet in packets:
                    sender.sendto(packet, ("::1", receiver.port))
            receiver._order.takes("nobody", None, float("inf"))  # whoever was first is gone
            receiver._order.sender = ""
            receiver._order._heard = float("-inf")
            (face,) = arrived(receiver, 2 * len(packets))
            torch.testing.assert_close(face.weights, WEIGHTS, atol=0.006, rtol=0)


def test_a_part_of_a_face_ends_no_wait() -> None:
    """Else each part would be a frame of its own, in which the face counts as not sent."""
    packets = VmcPackets(ARKIT)(WEIGHTS, ROTATIONS)
    assert len(packets) > 1
    with WeightReceiver("vmc://127.0.0.1:0") as receiver, udp() as sender:
        sender.connect(("127.0.0.1", receiver.port))
        sender.send(packets[0])
        rest = threading.Timer(0.1, lambda: [sender.send(packet) for packet in packets[1:]])
        rest.start()
        assert len(receiver.faces(5.0)) == 1
        rest.join()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have one address of their own, 127.0.0.1")
def test_the_phone_is_asked_to_send_until_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchface.io.protocols.weight_receiver._ASK_AGAIN", 0.02)
    with udp() as phone:
        phone.bind(("127.0.0.2", 0))
        phone.settimeout(5)
        port = phone.getsockname()[1]
        with WeightReceiver(f"ifacialmocap://127.0.0.2:{port}") as receiver:
            assert receiver.port == port  # where the app answers to
            assert receiver.asks
            receiver.faces(0.0)
            text, asker = phone.recvfrom(1024)
            assert text == START
            time.sleep(0.03)
            receiver.faces(0.0)
            assert phone.recv(1024) == START
            (packet,) = IFacialMocapPackets(ARKIT)(WEIGHTS, None)
            phone.sendto(packet, ("127.0.0.1", asker[1]))
            assert len(receiver.faces(5.0)) == 1


def test_a_second_sender_and_another_version_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchface.io.protocols.weight_receiver._SET", 10.0)  # of a machine that holds packets back
    packets = LiveLinkPackets(ARKIT, 60.0, "iPhone")
    frames = [packets(torch.full((52,), i / 10), None)[0] for i in range(6)]
    (other,) = LiveLinkPackets(ARKIT, 60.0, "iPad")(WEIGHTS, None)
    changed = b"\x07" + frames[4][1:]
    with WeightReceiver("livelink://127.0.0.1:0") as receiver:
        faces = played(receiver, [frames[0], frames[1], other, frames[3], frames[2], changed, frames[5]])
        counts = receiver.counts
    assert [round(face.weights[0].item() * 10) for face in faces] == [0, 1, 3, 5]
    assert (counts.others, counts.late, counts.malformed, counts.lost) == (1, 1, 1, 2)
    assert counts.fault == "found version 7, expected Live Link Face's version 6"
    assert "1 not understood (found version 7" in counts.words()


def test_two_programs_of_one_name_at_one_address_are_not_mixed() -> None:
    packets = [LiveLinkPackets(ARKIT, 60.0, "iPhone") for _ in range(2)]
    with (
        WeightReceiver("livelink://127.0.0.1:0") as receiver,
        udp() as first,
        udp() as second,
    ):
        for _ in range(20):
            for sender, encode, value in ((first, packets[0], 0.25), (second, packets[1], 0.75)):
                sender.sendto(encode(torch.full((52,), value), None)[0], ("127.0.0.1", receiver.port))
        faces = arrived(receiver, 40)
        counts = receiver.counts
    assert {face.weights[0].item() for face in faces[3:]} == {0.25}
    assert counts.others >= 18
    assert "of another sender" in counts.words()


@pytest.mark.parametrize("scheme", ["osc", "vmc"])
def test_parts_of_faces_of_two_programs_at_one_address_are_not_mixed(scheme: str) -> None:
    """Each sends a shape of its own by many packets, which come by turns."""

    def parts(name: str, value: float) -> list[bytes]:
        if scheme == "osc":
            return [osc_message(f"/face/{name}", value)]
        return [osc_message("/VMC/Ext/Blend/Val", name, value), osc_message("/VMC/Ext/Blend/Apply")]

    with (
        WeightReceiver(f"{scheme}://127.0.0.1:0") as receiver,
        udp() as first,
        udp() as second,
    ):
        for _ in range(20):
            for pair in zip(parts("jawOpen", 0.5), parts("cheekPuff", 0.75), strict=True):
                for sender, packet in zip((first, second), pair, strict=True):
                    sender.sendto(packet, ("127.0.0.1", receiver.port))
        faces = arrived(receiver, 40 if scheme == "osc" else 80)[3:]
    assert len(faces) >= 16
    assert {float(face.weights[ARKIT.index("jawOpen")]) for face in faces} == {0.5}
    assert {float(face.weights[ARKIT.index("cheekPuff")]) for face in faces} == {0.0}


def test_parts_of_a_face_from_a_new_port_each_are_one_face() -> None:
    with WeightReceiver("osc://127.0.0.1:0") as receiver, ExitStack() as ports:  # all stay open, so none comes again
        for name in ARKIT[:40]:
            (face,) = sent(ports.enter_context(udp()), receiver, [osc_message(f"/face/{name}", 0.5)])
    assert face.weights.count_nonzero() == 40


def test_a_program_that_sends_each_frame_from_another_port_is_one_sender() -> None:
    encode = LiveLinkPackets(ARKIT, 60.0, "script")
    with WeightReceiver("livelink://127.0.0.1:0") as receiver, ExitStack() as ports:
        faces = []
        for i in range(12):
            faces += sent(ports.enter_context(udp()), receiver, encode(torch.full((52,), i / 16), None))
    assert [face.weights[0].item() for face in faces] == [i / 16 for i in range(12)]
    assert receiver.counts.others == 0


def test_a_port_that_comes_twice_by_chance_stops_no_program_that_changes_ports() -> None:
    """Of 28,000 ports one of the last eight comes again each minute at 60 frames a second."""
    order, ports = FrameOrder(), [1, 2, 3, 2, *range(4, 30)]
    taken = [order.takes("script", i, i / 60, port) for i, port in enumerate(ports)]
    assert taken == [True] * 4 + [False] * 3 + [True] * 23


def test_a_program_that_begins_anew_at_another_port_is_taken_after_a_while() -> None:
    order = FrameOrder()
    assert [order.takes("phone", i, i / 60, 5) for i in range(3)] == [True] * 3
    assert not order.takes("phone", 3, 1.0, 6)
    assert order.takes("phone", 3, 2.1, 6)


def test_a_face_that_the_app_does_not_see_is_said() -> None:
    (packet,) = LiveLinkPackets(ARKIT, 60.0)(WEIGHTS, None)
    for cut in (packet[: -61 * 4 - 1], packet[: -61 * 4 - 1] + b"\0"):
        with WeightReceiver("livelink://127.0.0.1:0") as receiver:
            (face,) = played(receiver, [cut])
            assert not face.found


def test_a_port_that_is_taken_is_said() -> None:
    with (
        WeightReceiver("vmc://127.0.0.1:0") as first,
        pytest.raises(ValueRangeError, match=rf"cannot receive at .* \(another program has port {first.port}; end"),
    ):
        WeightReceiver(f"vmc://127.0.0.1:{first.port}")
    with pytest.raises(
        ValueRangeError, match=r"cannot receive at vmc://192\.0\.2\.1 .*one of this machine's addresses"
    ):
        WeightReceiver("vmc://192.0.2.1")


@pytest.mark.parametrize("make", [lambda: b"", lambda: b"\0" * 60_000, lambda: b"#bundle\0" + b"\0" * 8])
def test_packets_of_nobody_leave_the_receiver_alive(make: Callable[[], bytes]) -> None:
    (good,) = LiveLinkPackets(ARKIT, 60.0)(WEIGHTS, None)
    with WeightReceiver("livelink://127.0.0.1:0") as receiver:
        assert len(played(receiver, [make(), good])) == 1
        assert receiver.counts.malformed == 1


def took(order: FrameOrder, numbers: list[int | None], sender: str = "phone", now: float = 0.0) -> list[bool]:
    return [order.takes(sender, number, now) for number in numbers]


def test_lost_and_late_frames_are_counted() -> None:
    order = FrameOrder()
    assert took(order, [10, 11, 12, 15, 14, 15, 16]) == [True, True, True, True, False, False, True]
    assert (order.counts.taken, order.counts.lost, order.counts.late) == (5, 2, 2)
    assert order.counts.words() == "2 lost, 2 late"


def test_a_phone_at_half_its_clocks_rate_loses_nothing() -> None:
    order = FrameOrder()
    assert all(took(order, list(range(0, 200, 2))))
    assert order.counts.lost == 0
    order.takes("phone", 202, 0.0)  # one of its frames is missing
    assert order.counts.lost == 1


def test_a_clock_that_jumps_goes_on_from_there() -> None:
    order = FrameOrder()
    assert all(took(order, [100_000, 100_001, 5, 6, 7, 2_000_000, 2_000_001]))
    assert (order.counts.jumps, order.counts.lost, order.counts.late) == (2, 0, 0)


def test_an_app_that_sends_nothing_for_ten_seconds_has_not_set_its_clock() -> None:
    order = FrameOrder()
    assert [order.takes("phone", number, number / 60) for number in (60, 61, 661)] == [True] * 3
    assert order.counts.words() == ""
    order.takes("phone", 100_000, 661 / 60 + 0.1)
    assert order.counts.words() == "1 jump of its clock"


def test_a_clock_that_is_set_back_a_little_stops_nothing_for_longer_than_a_network_does() -> None:
    order = FrameOrder()
    assert all(order.takes("phone", number, number / 60) for number in range(120, 300))
    back = [order.takes("phone", number, 5 + (number - 150) / 60) for number in range(150, 240)]
    assert back == [False] * 11 + [True] * 79
    assert (order.counts.jumps, order.counts.late) == (1, 11)


def test_a_frame_of_the_clock_before_a_jump_is_late() -> None:
    order = FrameOrder()
    assert took(order, [100_000, 100_002, 5, 100_001, 6, 7]) == [True, True, True, False, True, True]
    assert (order.counts.jumps, order.counts.late) == (1, 1)


def test_a_sender_whose_number_never_changes_is_taken_as_it_comes() -> None:
    order = FrameOrder()
    taken = [order.takes("phone", 0, frame / 60) for frame in range(120)]
    assert all(taken[12:])
    assert order.counts.jumps == 0


def test_a_second_sender_waits_until_the_first_is_gone() -> None:
    order = FrameOrder()
    assert took(order, [1, 2], now=0.0) == [True, True]
    assert took(order, [500, 501], "other", now=1.0) == [False, False]
    assert took(order, [3], now=1.5) == [True]
    assert took(order, [502, 503], "other", now=4.0) == [True, True]
    assert order.sender == "other"
    assert took(order, [4], now=4.1) == [False]
    assert (order.counts.others, order.counts.lost, order.counts.jumps) == (3, 0, 0)


def test_senders_that_do_not_count_are_taken_as_they_come() -> None:
    order = FrameOrder()
    assert all(took(order, [None] * 5))
    assert order.counts.words() == ""


def test_addresses_of_osc_that_move_nothing_are_counted_and_named() -> None:
    addresses = [f"/avatar/parameters/v2/Tongue{axis}" for axis in "XY"]
    with WeightReceiver("osc://127.0.0.1:0") as receiver:
        played(receiver, [osc_message(address, 0.5) for address in (*addresses, *addresses, "/face/jawOpen")])
        assert receiver.counts.words() == f"2 addresses that move no shape ({', '.join(addresses)})"
