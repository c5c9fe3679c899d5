"""VMC and plain OSC as python-osc's own server receives them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
import torch
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_server import BlockingOSCUDPServer
from scipy.spatial.transform import Rotation

from torchface.errors import NameMismatchError
from torchface.io.protocols.vmc_and_osc_packets import OscPackets, VmcPackets, unity_quaternion
from torchface.io.protocols.weight_sender import WeightSender, open_sender
from torchface.io.weights.weight_csv import ROTATIONS
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
    packets = VmcPackets(ARKIT, iter([5.0, 5.25]).__next__)
    with closing(WeightSender(f"vmc://127.0.0.1:{receiver.port}", packets)) as sender:
        assert sender.send(WEIGHTS, ROTATION)
    messages = receiver.receive("/VMC/Ext/Blend/Apply")
    assert messages[-1] == ("/VMC/Ext/Blend/Apply", ())  # all values come before they are applied
    values_at: dict[str, list[tuple[Any, ...]]] = defaultdict(list)
    for address, values in messages:
        values_at[address].append(values)
    assert values_at["/VMC/Ext/OK"] == [(1,)]
    assert values_at["/VMC/Ext/T"] == [(0.25,)]
    assert dict(values_at["/VMC/Ext/Blend/Val"]) == dict(zip(ARKIT, WEIGHTS.tolist(), strict=True))
    ((name, *motion),) = values_at["/VMC/Ext/Bone/Pos"]
    assert name == "Head"
    assert motion[:3] == [0, 0, 0]
    assert motion[3:] == pytest.approx(unity_quaternion(ROTATION[:3]), abs=1e-6)


def test_vmc_packets_fit_an_ethernet_frame_and_take_any_rigs_names() -> None:
    packets = VmcPackets(("browInnerUp_L", "browInnerUp_R"))(torch.tensor([0.25, 0.75]), None)
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
    with closing(open_sender(f"osc://127.0.0.1:{receiver.port}/stage/left/", names, 60.0)) as sender:
        sender.send(torch.cat([WEIGHTS[:-1], torch.tensor([torch.nan])]), ROTATION)
    receiver.server.handle_request()
    expected = {f"/stage/left/weights/{name}": value for name, value in zip(names, WEIGHTS.tolist(), strict=True)}
    expected["/stage/left/weights/wing"] = 0.0
    expected |= {f"/stage/left/rotations/{name}": v for name, v in zip(ROTATIONS, ROTATION.tolist(), strict=True)}
    assert {address: value for address, (value,) in receiver.messages} == pytest.approx(expected)


def test_osc_has_a_prefix_of_its_own(receiver: Receiver) -> None:
    with closing(open_sender(f"osc://127.0.0.1:{receiver.port}", ["jawOpen"], 60.0)) as sender:
        sender.send(torch.tensor([0.5]))
    receiver.server.handle_request()
    assert ("/torchface/weights/jawOpen", (0.5,)) in receiver.messages


def test_names_that_a_protocol_cannot_carry() -> None:
    with pytest.raises(NameMismatchError, match="found the shape 'jaw open'"):
        OscPackets(["jaw open"])
    with pytest.raises(NameMismatchError, match="expected some of ARKit's"):
        VmcPackets(["wing"])


def test_frames_arrive_in_their_order(receiver: Receiver) -> None:
    with closing(open_sender(f"osc://127.0.0.1:{receiver.port}", ["jawOpen"], 60.0)) as sender:
        for frame in range(12):
            sender.send(torch.tensor([frame / 32]))
    messages = receiver.receive("/torchface/weights/jawOpen", 12)
    assert [values[0] for address, values in messages if address.endswith("jawOpen")] == [i / 32 for i in range(12)]
