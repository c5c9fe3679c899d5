"""iFacialMocap's text, read by a parser written from the app's specification and from its own example."""

import re

import pytest
import torch

from torchface.errors import FileFormatError
from torchface.io.protocols.ifacialmocap_packets import START, IFacialMocapPackets, read_ifacialmocap
from torchface.shape_names import ARKIT

WEIGHTS = torch.arange(52) / 52
ROTATION = torch.arange(1, 10) / 16

# A frame as the app's page for developers shows it.
SHOWN = (
    "mouthSmile_R-0|eyeLookOut_L-0|mouthUpperUp_L-11|eyeWide_R-0|mouthClose-8|mouthPucker-4|mouthRollLower-9|"
    "eyeBlink_R-7|eyeLookDown_L-17|cheekSquint_R-11|eyeBlink_L-7|tongueOut-0|jawRight-0|eyeLookIn_R-6|mouthLeft-1|"
    "=head#-21.488958,-6.038993,-6.6019735,-0.030653415,-0.10287084,-0.6584072|"
    "rightEye#6.0297494,2.4403017,0.25649446|leftEye#6.034903,-1.6660284,-0.17520553|"
)


def by_specification(packet: bytes) -> tuple[dict[str, float], dict[str, list[float]]]:
    """``name-percent|...|=head#x,y,z,px,py,pz|rightEye#x,y,z|leftEye#x,y,z|``."""
    shapes, bones = {}, {}
    *fields, rest = packet.decode().split("|")
    assert rest == ""
    for field in fields:
        if "#" in field:
            name, numbers = field.split("#")
            bones[name] = [float(number) for number in numbers.split(",")]
        else:
            name, number = field.rsplit("-", 1)
            assert re.fullmatch("[0-9]{1,3}", number)
            shapes[name] = int(number)
    return shapes, bones


def test_a_frame_is_as_the_specification_says() -> None:
    (packet,) = IFacialMocapPackets(ARKIT)(WEIGHTS, ROTATION)
    shapes, bones = by_specification(packet)
    expected = {}
    for name, weight in zip(ARKIT, WEIGHTS.tolist(), strict=True):
        spelled = re.sub(r"(?<!^jaw)(?<!^mouth)(Left|Right)$", lambda side: "_" + side[0][0], name)
        expected[spelled] = round(100 * weight)
    assert shapes == expected
    assert "eyeBlink_L" in shapes
    assert "mouthLeft" in shapes
    degrees = (ROTATION * 180 / torch.pi).tolist()
    assert bones["=head"] == pytest.approx([degrees[1], degrees[0], degrees[2], 0, 0, 0], abs=1e-4)
    assert bones["leftEye"] == pytest.approx([degrees[4], -degrees[3], 0], abs=1e-4)
    assert bones["rightEye"] == pytest.approx([degrees[7], -degrees[6], 0], abs=1e-4)


def test_the_apps_own_example_is_read() -> None:
    (face,) = read_ifacialmocap(SHOWN.encode())
    found = {name: face.weights[ARKIT.index(name)].item() for name in ("eyeBlinkLeft", "mouthLeft", "eyeLookInRight")}
    assert found == pytest.approx({"eyeBlinkLeft": 0.07, "mouthLeft": 0.01, "eyeLookInRight": 0.06})
    degrees = (face.rotations * 180 / torch.pi).tolist()
    assert degrees[:3] == pytest.approx([-6.038993, -21.488958, -6.6019735], abs=1e-4)
    # Both eyes look down and in: the left one to the person's right, which is positive.
    assert degrees[3:] == pytest.approx([1.6660284, 6.034903, 0, -2.4403017, 6.0297494, 0], abs=1e-4)


@pytest.mark.parametrize("mark", ["-", "&"])
def test_what_is_sent_is_received_in_both_versions(mark: str) -> None:
    (packet,) = IFacialMocapPackets(ARKIT)(WEIGHTS, ROTATION)
    text = re.sub(r"([a-zA-Z_]+)-(\d+)(?=\|)", rf"\g<1>{mark}\g<2>", packet.decode())
    (face,) = read_ifacialmocap(text.encode())
    torch.testing.assert_close(face.weights, WEIGHTS, atol=0.0051, rtol=0)
    torch.testing.assert_close(face.rotations[[0, 1, 2, 3, 4, 6, 7]], ROTATION[[0, 1, 2, 3, 4, 6, 7]])


def test_handshakes_are_no_faces_and_other_texts_are_refused() -> None:
    assert read_ifacialmocap(START + b"|sendDataVersion=v2") == []
    for packet in (b"", b"wing-5|", b"jawOpen-x|", b"\xff\xfe", b"jawOpen-9|=head#1,2|", b"jawOpen-9|=head#1,2,nan|"):
        with pytest.raises(FileFormatError, match=r"^packet: found"):
            read_ifacialmocap(packet)
    for packet in (b"jawOpen-9" * 4000, b"jawOpen-9|" * 401, b"jawOpen-900|"):
        with pytest.raises(FileFormatError, match=r"^packet: found .* expected at most"):
            read_ifacialmocap(packet)
