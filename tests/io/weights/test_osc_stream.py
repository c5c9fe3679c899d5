"""VMC and plain OSC as python-osc's own server receives them, and receivers that are not there."""

from __future__ import annotations

import socket
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
import torch
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_server import BlockingOSCUDPServer
from scipy.spatial.transform import Rotation

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.io.weights.live_link_stream import LiveLinkSender
from torchface.io.weights.osc_stream import OscSender, VmcSender, unity_quaternion
from torchface.io.weights.udp_sending import StreamAddress, UdpSocket, parse_address
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.io.weights.weight_senders import open_sender
from torchface.shape_names import ARKIT

WEIGHTS = torch.arange(52) / 64
ROTATION = torch.arange(1, 10) / 16


class Receiver:
    """python-osc's server on a port of its own; keeps every message in its order."""

    def __init__(self) -> None:
        dispatcher = Dispatcher()
        dispatcher.set_default_handler(self._take)
        self.server = BlockingOSCUDPServer(("127.0.0.1", 0), dispatcher)
        self.server.timeout = 5
        self.port = self.server.server_address[1]
        self.messages: list[tuple[str, tuple[Any, ...]]] = []

    def _take(self, address: str, *values: Any) -> None:
        self.messages.append((address, values))

    def receive(self, until: str, count: int = 1) -> list[tuple[str, tuple[Any, ...]]]:
        """Handles packets until so many messages of an address are there."""
        for _ in range(20):
            if sum(address == until for address, _ in self.messages) >= count:
                return self.messages
            self.server.handle_request()
        raise AssertionError(f"{until} did not come: {self.messages}")


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    opened = Receiver()
    yield opened
    opened.server.server_close()


def test_a_frame_arrives_by_the_vmc_protocol(receiver: Receiver) -> None:
    with closing(VmcSender(f"vmc://127.0.0.1:{receiver.port}", ARKIT, iter([5.0, 5.25]).__next__)) as sender:
        assert sender.send(WEIGHTS, ROTATION)
    messages = receiver.receive("/VMC/Ext/Blend/Apply")
    assert messages[-1] == ("/VMC/Ext/Blend/Apply", ())  # all values come before they are applied
    found: dict[str, list[tuple[Any, ...]]] = defaultdict(list)
    for address, values in messages:
        found[address].append(values)
    assert found["/VMC/Ext/OK"] == [(1,)]
    assert found["/VMC/Ext/T"] == [(0.25,)]
    assert dict(found["/VMC/Ext/Blend/Val"]) == dict(zip(ARKIT, WEIGHTS.tolist(), strict=True))
    ((name, *place),) = found["/VMC/Ext/Bone/Pos"]
    assert name == "Head"
    assert place[:3] == [0, 0, 0]
    assert place[3:] == pytest.approx(unity_quaternion(ROTATION[:3]), abs=1e-6)


def test_vmc_packets_fit_an_ethernet_frame_and_take_any_rigs_names() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as raw:
        raw.bind(("127.0.0.1", 0))
        raw.settimeout(5)
        names = ("browInnerUp_L", "browInnerUp_R")
        with closing(VmcSender(f"vmc://127.0.0.1:{raw.getsockname()[1]}", names)) as sender:
            sender.send(torch.tensor([0.25, 0.75]))
        packets = [raw.recv(65536)]
        while b"/VMC/Ext/Blend/Apply" not in packets[-1]:
            packets.append(raw.recv(65536))
    assert all(len(packet) <= 1400 and packet.startswith(b"#bundle\0") for packet in packets)
    at = (whole := b"".join(packets)).index(b"browInnerUp\0")
    assert whole[at + 12 : at + 16] == b"\x3f\x00\x00\x00"  # 0.5, the mean of the halves


def test_the_heads_rotation_is_unitys() -> None:
    for angles in torch.randn(20, 3, generator=torch.Generator().manual_seed(1)) * 0.5:
        yaw, pitch, roll = angles.tolist()
        ours = (
            Rotation.from_euler("y", yaw) * Rotation.from_euler("x", pitch) * Rotation.from_euler("z", roll)
        ).as_matrix()
        flip = torch.diag(torch.tensor([-1.0, 1, 1])).double().numpy()
        x, y, z, w = unity_quaternion(angles)
        # The same matrix in both hands' coordinates, x turned round.
        torch.testing.assert_close(
            torch.tensor(Rotation.from_quat([x, y, z, w]).as_matrix()), torch.tensor(flip @ ours @ flip)
        )
    assert unity_quaternion(torch.full((3,), torch.nan)) == (0, 0, 0, 1)


def test_a_frame_arrives_as_plain_osc_in_one_bundle(receiver: Receiver) -> None:
    names = (*ARKIT[:-1], "wing")  # any names: nothing maps them
    with closing(OscSender(f"osc://127.0.0.1:{receiver.port}/stage/left/", names)) as sender:
        sender.send(torch.cat([WEIGHTS[:-1], torch.tensor([torch.nan])]), ROTATION)
    receiver.server.handle_request()
    expected = {f"/stage/left/weights/{name}": value for name, value in zip(names, WEIGHTS.tolist(), strict=True)}
    expected["/stage/left/weights/wing"] = 0.0
    expected |= {f"/stage/left/rotations/{name}": v for name, v in zip(ROTATIONS, ROTATION.tolist(), strict=True)}
    assert {address: value for address, (value,) in receiver.messages} == pytest.approx(expected)


def test_osc_has_a_prefix_of_its_own(receiver: Receiver) -> None:
    with closing(OscSender(f"osc://127.0.0.1:{receiver.port}", ["jawOpen"])) as sender:
        sender.send(torch.tensor([0.5]))
    receiver.server.handle_request()
    assert ("/torchface/weights/jawOpen", (0.5,)) in receiver.messages


def test_addresses_name_protocol_and_port() -> None:
    assert parse_address("vmc://studio.local") == StreamAddress("vmc", "studio.local", 39539)
    assert parse_address("livelink://10.0.0.7") == StreamAddress("livelink", "10.0.0.7", 11111)
    assert parse_address("osc://[::1]:9000/a/b/") == StreamAddress("osc", "::1", 9000, "/a/b")
    kinds = {"udp": LiveLinkSender, "livelink": LiveLinkSender, "vmc": VmcSender, "osc": OscSender}
    for scheme, kind in kinds.items():
        with closing(open_sender(f"{scheme}://127.0.0.1:9", ARKIT, 30.0)) as sender:
            assert type(sender) is kind


@pytest.mark.parametrize(
    "address", ["osc://127.0.0.1", "vmc://h:0", "vmc://h:39539/x", "http://h:1", "vmc:/h", "osc://h:9000/a b", ""]
)
def test_addresses_that_are_none(address: str) -> None:
    with pytest.raises(ValueRangeError, match=r"stream: found .* expected an address such as udp://.*vmc://.*osc://"):
        open_sender(address, ARKIT, 30.0)


def test_names_that_a_protocol_cannot_carry() -> None:
    with pytest.raises(NameMismatchError, match="found the shape 'jaw open'"):
        OscSender("osc://127.0.0.1:9000", ["jaw open"])
    with pytest.raises(NameMismatchError, match="expected some of ARKit's"):
        VmcSender("vmc://127.0.0.1:9000", ["wing"])


def test_nobody_listening_is_told_and_the_next_listener_gets_the_frames() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as empty:
        empty.bind(("127.0.0.1", 0))
        port = empty.getsockname()[1]
    sender = UdpSocket(f"vmc://127.0.0.1:{port}")
    with closing(sender):
        assert [sender.send(b"x") for _ in range(4)] == [True, False, False, False]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
            late.bind(("127.0.0.1", port))
            late.settimeout(5)
            sender.send(b"first")  # the system tells of the one before, and this one goes all the same
            assert sender.send(b"second")
            assert (late.recv(16), late.recv(16)) == (b"first", b"second")


def test_frames_arrive_in_their_order(receiver: Receiver) -> None:
    with closing(OscSender(f"osc://127.0.0.1:{receiver.port}", ["jawOpen"])) as sender:
        for frame in range(12):
            sender.send(torch.tensor([frame / 32]))
    messages = receiver.receive("/torchface/weights/jawOpen", 12)
    assert [values[0] for address, values in messages if address.endswith("jawOpen")] == [i / 32 for i in range(12)]
