"""What comes to an address: which faces are frames, and what the status line says of the sender."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchface.io.protocols.live_link_packets import LiveLinkPackets
from torchface.io.protocols.osc_messages import osc_bundles, osc_message
from torchface.shape_names import ARKIT
from torchface.workflows.live import received_source
from torchface.workflows.live.received_source import ReceivedSource, ReceivedWatch

PICTURE = np.zeros((4, 4, 3), np.uint8)


@contextmanager
def listening(address: str) -> Iterator[tuple[ReceivedSource, ReceivedWatch, list[str]]]:
    source, said = ReceivedSource(address), list[str]()
    try:
        yield source, ReceivedWatch(source, said.append), said
    finally:
        source.close()


def test_the_status_line_says_who_sends_what_is_lost_and_that_it_ended() -> None:
    packets, said = LiveLinkPackets(ARKIT, 60.0, "iPhone"), list[str]()
    source = ReceivedSource("livelink://127.0.0.1:0")
    try:
        watch, frames = ReceivedWatch(source, said.append), source.frames()

        def shown(packet: bytes | None) -> str:
            if packet is not None:
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                    sender.sendto(packet, ("127.0.0.1", source.receiver.port))
            came, picture = next(frames)
            watch.look(picture, True, came)
            return watch.words

        assert shown(None).startswith("Waiting for a face at port")
        whole = [packets(torch.zeros(52), None)[0] for _ in range(6)]
        assert "1 not understood (found version 9" in shown(b"\x09" + whole[0][1:])
        assert shown(whole[0]).startswith("Receiving from iPhone 127.0.0.1")
        shown(whole[1])
        assert "2 lost" in shown(whole[4])
        source.heard -= 3.0
        assert "the last expression is held, then relaxes (3 s)" in shown(None)
        assert "sees no face" in shown(whole[5][: -61 * 4 - 1])
    finally:
        source.close()
    assert len(said) == len(set(said)) == 5


def test_where_nothing_arrives_it_is_said_once_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(received_source, "own_address", lambda: "192.168.1.5")
    monkeypatch.setattr(received_source, "other_addresses", lambda: ["10.0.0.7"])
    with listening("livelink://:0") as (source, watch, said):
        at = f"port {source.receiver.port} (UDP): have the app send to 192.168.1.5"
        for now in (1000.0, 1004.9, 1005.0, 1006.0, 1100.0):
            watch.look(PICTURE, SimpleNamespace(), now)
        assert said == [
            f"Waiting for a face at {at}",
            f"For 5 seconds no packet has come to {at} (or to 10.0.0.7, whichever is in its network). A firewall on "
            "this machine may hold packets back",
        ]
        assert watch.words == said[1]


@pytest.mark.parametrize(
    ("address", "packet", "kind"),
    [
        (
            "livelink",
            osc_message("/face/jawOpen", 0.5),
            "OSC; osc://:{} receives those · 3 not understood (found version",
        ),
        ("livelink", osc_bundles([osc_message("/VMC/Ext/Blend/Apply")])[0], "VMC; vmc://:{} receives those"),
        ("osc", osc_bundles([osc_message("/VMC/Ext/Blend/Val", "A", 0.5)])[0], "VMC; vmc://:{} receives those"),
        ("osc", LiveLinkPackets(ARKIT, 60.0)(torch.zeros(52), None)[0], "Live Link Face; livelink://:{} receives"),
        ("vmc", b"mouthSmile_R-5|eyeBlink_L-10|", "iFacialMocap; ifacialmocap://:{} receives those"),
        ("livelink", b'{"a": 1}', "text ('{{\"a\": 1}}') · 3 not understood"),
        ("livelink", b"\x09\xff\x00\x01more", "bytes 09 ff 00 01 · 3 not understood"),
    ],
)
def test_packets_of_another_protocol_are_counted_and_named(address: str, packet: bytes, kind: str) -> None:
    with listening(f"{address}://127.0.0.1:0") as (source, watch, said):
        watch.look(PICTURE, SimpleNamespace(), 0.0)
        frames, port = source.frames(), source.receiver.port
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for _ in range(3):
                sender.sendto(packet, ("127.0.0.1", port))
        next(frames)
        watch.look(PICTURE, SimpleNamespace(), 5.0)
        expected = f"For 5 seconds no face has come, but packets (3) that look like {kind.format(port)}"
        assert watch.words.startswith(expected)
        assert said[-1] == watch.words
        assert source.silence.startswith("no face has come, but packets (3)")


@pytest.mark.parametrize(
    ("address", "hint"),
    [
        ("livelink://127.0.0.1:0", "which only this machine reaches; for a phone, start with livelink://:{}"),
        ("vmc://localhost:0", "which only this machine reaches; for a phone, start with vmc://:{}"),
        ("ifacialmocap://127.0.0.1:49983", "ifacialmocap://127.0.0.1:49983 is asked to send; open iFacialMocap there"),
    ],
)
def test_where_a_phone_cannot_reach_the_hint_says_what_to_type(address: str, hint: str) -> None:
    with listening(address) as (source, watch, _):
        assert watch.words.endswith(hint.format(source.receiver.port))
        assert "have the app send to" not in watch.words


def test_only_the_newest_of_several_faces_is_given_unless_every_one_is_recorded() -> None:
    packets = LiveLinkPackets(ARKIT, 60.0)
    for every, expected in ((False, [0.5]), (True, [0.1, 0.2, 0.3, 0.4, 0.5])):
        source = ReceivedSource("livelink://127.0.0.1:0", every)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for i in range(1, 6):
                sender.sendto(packets(torch.full((52,), i / 10), None)[0], ("127.0.0.1", source.receiver.port))
        frames, found = source.frames(), []
        for _ in expected:
            next(frames)
            found.append(round(source.face.weights[0].item(), 3))
        source.close()
        assert found == expected
        assert source.dropped == 5 - len(expected)


def test_what_came_while_a_character_was_read_is_no_frame() -> None:
    packets = LiveLinkPackets(ARKIT, 60.0)
    with (
        listening("livelink://127.0.0.1:0") as (source, _, _),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        for i in range(1, 6):
            if i == 5:
                source.skip()
            sender.sendto(packets(torch.full((52,), i / 10), None)[0], ("127.0.0.1", source.receiver.port))
        next(source.frames())
        assert source.face.weights[0].item() == pytest.approx(0.5)
        assert source.dropped == 0


def test_weights_that_come_one_by_one_are_one_frame_of_a_recording() -> None:
    source = ReceivedSource("osc://127.0.0.1:0", every=True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for i, name in enumerate(ARKIT):
            sender.sendto(osc_message(f"/face/{name}", i / 64), ("127.0.0.1", source.receiver.port))
    next(source.frames())
    source.close()
    torch.testing.assert_close(source.face.weights, torch.arange(52) / 64)
    assert source.dropped == 0


def test_packets_that_change_are_named_once() -> None:
    with (
        listening("livelink://127.0.0.1:0") as (source, watch, said),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        frames = source.frames()
        watch.look(PICTURE, SimpleNamespace(), 0.0)
        for i in range(5):
            sender.sendto(b'{"t": %d}' % i, ("127.0.0.1", source.receiver.port))
            next(frames)
            watch.look(PICTURE, SimpleNamespace(), 6.0 + i)
    assert len(said) == 2
    assert "look like text" in said[1]


@pytest.mark.parametrize("scheme", ["livelink", "osc"])
def test_the_last_face_that_came_before_the_start_is_the_first_frame_where_none_comes(scheme: str) -> None:
    live_link = LiveLinkPackets(ARKIT, 60.0)(torch.full((52,), 0.5), None)[0]
    packet = live_link if scheme == "livelink" else osc_message("/jawOpen", 0.5)
    with (
        listening(f"{scheme}://127.0.0.1:0") as (source, watch, said),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        sender.sendto(packet, ("127.0.0.1", source.receiver.port))
        source.skip()
        frames, fresh = source.frames(), list[bool]()
        for _ in range(2):
            now, picture = next(frames)
            fresh.append(source.fresh)
            watch.look(picture, SimpleNamespace(), now)
        assert fresh == [True, False]
        assert source.face.weights[ARKIT.index("jawOpen")].item() == pytest.approx(0.5)
        assert source.silence == ""
        assert said[-1].startswith("Receiving from")
