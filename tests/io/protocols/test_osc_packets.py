"""Plain OSC as python-osc's own server receives it, and faces under several programs' addresses."""

from contextlib import closing

import pytest
import torch
from osc_receiver import OscReceiver

from torchface.errors import NameMismatchError
from torchface.io.protocols.osc_messages import osc_bundles, osc_message
from torchface.io.protocols.osc_packets import OscPackets, OscReader
from torchface.io.protocols.vrchat_packets import VrchatPackets
from torchface.io.protocols.weight_sender import open_sender
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT

WEIGHTS = torch.arange(52) / 64
ROTATION = torch.arange(1, 10) / 16


def test_a_frame_arrives_as_plain_osc_in_one_bundle(receiver: OscReceiver) -> None:
    names = (*ARKIT[:-1], "wing")  # any names: nothing maps them
    with closing(open_sender(f"osc://127.0.0.1:{receiver.port}/stage/left/", names, 60.0)) as sender:
        sender.send(torch.cat([WEIGHTS[:-1], torch.tensor([torch.nan])]), ROTATION)
    receiver.server.handle_request()
    expected = {f"/stage/left/weights/{name}": value for name, value in zip(names, WEIGHTS.tolist(), strict=True)}
    expected["/stage/left/weights/wing"] = 0.0
    expected |= {f"/stage/left/rotations/{name}": v for name, v in zip(ROTATIONS, ROTATION.tolist(), strict=True)}
    assert {address: value for address, (value,) in receiver.messages} == pytest.approx(expected)


def test_osc_has_a_prefix_of_its_own(receiver: OscReceiver) -> None:
    with closing(open_sender(f"osc://127.0.0.1:{receiver.port}", ["jawOpen"], 60.0)) as sender:
        sender.send(torch.tensor([0.5]))
    receiver.server.handle_request()
    assert ("/torchface/weights/jawOpen", (0.5,)) in receiver.messages


def test_names_that_an_address_cannot_carry() -> None:
    with pytest.raises(NameMismatchError, match="found the shape 'jaw open'"):
        OscPackets(["jaw open"])


def test_frames_arrive_in_their_order(receiver: OscReceiver) -> None:
    with closing(open_sender(f"osc://127.0.0.1:{receiver.port}", ["jawOpen"], 60.0)) as sender:
        for frame in range(12):
            sender.send(torch.tensor([frame / 32]))
    messages = receiver.receive("/torchface/weights/jawOpen", 12)
    assert [values[0] for address, values in messages if address.endswith("jawOpen")] == [i / 32 for i in range(12)]


def test_what_is_sent_is_received_and_other_prefixes_are_passed_over() -> None:
    (packet,) = OscPackets(ARKIT, "/face")(WEIGHTS, ROTATION)
    (face,) = OscReader("/face")(packet)
    torch.testing.assert_close(face.weights, WEIGHTS)
    torch.testing.assert_close(face.rotations, ROTATION)
    assert OscReader("/other")(packet) == []


def test_unified_expressions_move_arkits_shapes() -> None:
    reader, found = OscReader(), []
    for packet in VrchatPackets(ARKIT, ["unified"])(WEIGHTS, None):
        found += reader(packet)
    torch.testing.assert_close(found[-1].weights, WEIGHTS)


def test_face_caps_own_addresses() -> None:
    messages = [osc_message("/W", 24, 0.5), osc_message("/HR", 10.0, 20.0, -5.0), osc_message("/ELR", 3.0, -4.0)]
    (face,) = OscReader()(osc_bundles(messages)[0])
    assert face.weights[ARKIT.index("jawOpen")] == 0.5
    degrees = (face.rotations * 180 / torch.pi).tolist()
    assert degrees == pytest.approx([20, 10, -5, 4, 3, 0, 0, 0, 0], abs=1e-4)  # yaw, pitch, roll; eyes to the right
    assert OscReader()(osc_message("/W", 52, 0.5)) == []
    assert OscReader()(osc_message("/avatar/parameters/VRCEmote", 3)) == []
