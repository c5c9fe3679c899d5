"""VMC as python-osc's own server receives it, and faces gathered from packets."""

from collections import defaultdict
from contextlib import closing
from typing import Any

import pytest
import torch
from osc_receiver import OscReceiver, values_by_address
from pythonosc.osc_message_builder import OscMessageBuilder
from scipy.spatial.transform import Rotation

from torchface.errors import FileFormatError, NameMismatchError, ShapeError
from torchface.io.protocols.osc_messages import osc_bundles, osc_message
from torchface.io.protocols.vmc_packets import NAMINGS, VmcPackets, VmcReader, unity_angles, unity_quaternion
from torchface.io.protocols.weight_sender import WeightSender
from torchface.shape_names import ARKIT, VRM0, VRM1

WEIGHTS = torch.arange(52) / 64
ROTATION = torch.arange(1, 10) / 16


def test_a_frame_arrives_by_the_vmc_protocol(receiver: OscReceiver) -> None:
    packets = VmcPackets(ARKIT, NAMINGS[:3], iter([5.0, 5.25]).__next__)
    with closing(WeightSender(f"vmc://127.0.0.1:{receiver.port}", packets)) as sender:
        assert sender.send(WEIGHTS, ROTATION)
    messages = receiver.receive("/VMC/Ext/Blend/Apply")
    assert messages[-1] == ("/VMC/Ext/Blend/Apply", ())  # all values come before they are applied
    values_at: dict[str, list[tuple[Any, ...]]] = defaultdict(list)
    for address, values in messages:
        values_at[address].append(values)
    assert values_at["/VMC/Ext/OK"] == [(1,)]
    assert values_at["/VMC/Ext/T"] == [(0.25,)]
    assert values_at["/VMC/Ext/Root/Pos"] == [("root", 0, 0, 0, 0, 0, 0, 1)]
    clips = dict(values_at["/VMC/Ext/Blend/Val"])
    assert {name: clips[name] for name in ARKIT} == dict(zip(ARKIT, WEIGHTS.tolist(), strict=True))
    expected = VRM0.from_arkit(WEIGHTS).tolist()
    for names in (VRM0.names, VRM1.names):
        assert [clips[name] for name in names] == pytest.approx(expected, abs=1e-6)
    assert len(clips) == 52 + 2 * 13
    bones = {name: motion for name, *motion in values_at["/VMC/Ext/Bone/Pos"]}
    assert set(bones) == {"Head", "Neck", "LeftEye", "RightEye"}
    assert all(motion[:3] == [0, 0, 0] for motion in bones.values())
    both = Rotation.from_quat(bones["Neck"][3:]) * Rotation.from_quat(bones["Head"][3:])
    head = Rotation.from_quat(unity_quaternion(ROTATION[:3]))
    assert (both.inv() * head).magnitude() < 1e-6
    assert Rotation.from_quat(bones["Neck"][3:]).magnitude() == pytest.approx(0.3 * head.magnitude(), abs=1e-6)
    # Unity's y turns to the right, as the yaw of eyes does.
    assert Rotation.from_quat(bones["LeftEye"][3:]).as_euler("YXZ")[0] == pytest.approx(float(ROTATION[3]), abs=1e-5)


@pytest.mark.parametrize(
    ("namings", "names"),
    [(("arkit",), ARKIT), (("vrm0",), VRM0.names), (("vrm1",), VRM1.names), (("vrm0", "own"), (*VRM0.names, *ARKIT))],
)
def test_only_the_names_that_are_asked_for_are_sent(namings: tuple[str, ...], names: tuple[str, ...]) -> None:
    values = values_by_address(VmcPackets(ARKIT, namings)(WEIGHTS, None))["/VMC/Ext/Blend/Val"]
    assert {name for name, _ in values} == set(names)


def test_vmc_packets_fit_an_ethernet_frame_and_take_any_rigs_names() -> None:
    packets = VmcPackets(("browInnerUp_L", "browInnerUp_R"))(torch.tensor([0.25, 0.75]), None)
    assert all(len(packet) <= 1400 and packet.startswith(b"#bundle\0") for packet in packets)
    clips = dict(values_by_address(packets)["/VMC/Ext/Blend/Val"])
    assert clips["browInnerUp"] == 0.5  # the mean of the halves
    with pytest.raises(NameMismatchError, match="expected some of ARKit's"):
        VmcPackets(["wing"])
    own = VmcPackets(["wing"], ["own"])
    assert values_by_address(own(torch.ones(1), None))["/VMC/Ext/Blend/Val"] == [("wing", 1.0)]
    with pytest.raises(ShapeError, match=r"found weights \(2,\), expected \(1,\)"):
        own(torch.ones(2), None)


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
        assert unity_angles((x, y, z, w)) == pytest.approx(angles.tolist(), abs=1e-6)
    assert unity_quaternion(torch.full((3,), torch.nan)) == (0, 0, 0, 1)


def test_what_is_sent_is_received() -> None:
    reader = VmcReader()
    packets = VmcPackets(ARKIT)(WEIGHTS, ROTATION)
    assert [reader(packet) for packet in packets[:-1]] == [[]] * (len(packets) - 1)  # whole with the last one
    (face,) = reader(packets[-1])
    torch.testing.assert_close(face.weights, WEIGHTS)
    torch.testing.assert_close(face.rotations, ROTATION, atol=1e-5, rtol=0)


def test_a_sender_that_has_vrms_clips_alone_moves_arkits_shapes() -> None:
    for names in (VRM0.names, VRM1.names):
        reader = VmcReader()
        clips = {names[0]: 1.0, names[7]: 0.5}  # A and Blink_R
        messages = [osc_message("/VMC/Ext/Blend/Val", name, value) for name, value in clips.items()]
        (face,) = reader(osc_bundles([*messages, osc_message("/VMC/Ext/Blend/Apply")])[0])
        assert face.weights[ARKIT.index("jawOpen")] == pytest.approx(0.7)
        assert face.weights[ARKIT.index("eyeBlinkRight")] == pytest.approx(0.5)
        assert face.weights[ARKIT.index("eyeBlinkLeft")] == 0


def test_messages_of_python_osc_are_read_and_wrong_values_refused() -> None:
    reader = VmcReader()
    for name in ("JawOpen", "eyeBlink_L"):
        builder = OscMessageBuilder("/VMC/Ext/Blend/Val")
        builder.add_arg(name)
        builder.add_arg(0.25)
        assert reader(builder.build().dgram) == []
    (face,) = reader(OscMessageBuilder("/VMC/Ext/Blend/Apply").build().dgram)
    assert face.weights[ARKIT.index("eyeBlinkLeft")] == face.weights[ARKIT.index("jawOpen")] == 0.25
    for values in (("JawOpen",), (0.5, 0.5), ("JawOpen", "much"), ("JawOpen", float("nan"))):
        with pytest.raises(FileFormatError, match=r"packet: found the values .*, expected a name and 1 numbers"):
            reader(osc_message("/VMC/Ext/Blend/Val", *values))
    reader(osc_message("/VMC/Ext/Blend/Val", "jawOpen", 1e6))
    with pytest.raises(FileFormatError, match=r"packet: found a weight of 1e\+06, expected at most 5"):
        reader(osc_message("/VMC/Ext/Blend/Apply"))
