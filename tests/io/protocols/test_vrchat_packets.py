"""VRChat's parameters as python-osc reads them, each value by its definition."""

import math

import pytest
import torch
from osc_receiver import values_by_address

from torchface.errors import NameMismatchError, ShapeError
from torchface.io.protocols.vrchat_packets import VrchatPackets
from torchface.shape_names import ARKIT, UNIFIED

WEIGHTS = torch.rand(52, generator=torch.Generator().manual_seed(2))
ROTATION = torch.tensor([0.1, 0.2, 0.3, 0.2, -0.1, 0.0, 0.4, 0.05, 0.0])
BY_NAME = dict(zip(ARKIT, WEIGHTS.tolist(), strict=True))


@pytest.fixture(scope="module")
def sent() -> dict[str, float]:
    """Values by address, of messages of one value."""
    packets = VrchatPackets(ARKIT)(WEIGHTS, ROTATION)
    assert all(len(packet) <= 1400 for packet in packets)
    return {address: values[0][0] for address, values in values_by_address(packets).items() if len(values[0]) == 1}


def test_base_expressions_and_arkits_names_are_parameters(sent: dict[str, float]) -> None:
    for arkit, twins in UNIFIED.twins.items():
        assert sent[f"/avatar/parameters/{arkit}"] == pytest.approx(BY_NAME[arkit], abs=1e-6)
        for twin in twins:
            assert sent[f"/avatar/parameters/v2/{twin}"] == pytest.approx(BY_NAME[arkit], abs=1e-6)
    assert not any(f"/avatar/parameters/v2/{name}" in sent for name in UNIFIED.others)
    assert sent["/avatar/parameters/EyeTrackingActive"] is True
    assert sent["/avatar/parameters/LipTrackingActive"] is True


def test_combined_parameters_are_what_the_standard_says(sent: dict[str, float]) -> None:
    b = BY_NAME
    smile = {side: b[f"mouthSmile{side}"] for side in ("Left", "Right")}
    expected = {
        "JawX": b["jawRight"] - b["jawLeft"],
        "JawZ": b["jawForward"],
        "MouthX": b["mouthRight"] - b["mouthLeft"],
        "SmileFrownLeft": smile["Left"] - b["mouthFrownLeft"],
        "SmileFrown": sum(smile.values()) / 2 - (b["mouthFrownLeft"] + b["mouthFrownRight"]) / 2,
        "EyeLidRight": 0.75 * (1 - b["eyeBlinkRight"]) + 0.25 * b["eyeWideRight"],
        "EyeOpenLeft": 1 - b["eyeBlinkLeft"],
        "EyeClosed": (b["eyeBlinkLeft"] + b["eyeBlinkRight"]) / 2,
        "EyeWide": max(b["eyeWideLeft"], b["eyeWideRight"]),
        "BrowUpLeft": 0.6 * b["browOuterUpLeft"] + 0.4 * b["browInnerUp"],
        "BrowDownRight": b["browDownRight"],
        "BrowExpressionLeft": (b["browInnerUp"] + b["browOuterUpLeft"]) / 2 - b["browDownLeft"],
        "CheekPuffSuck": b["cheekPuff"],
        "LipFunnel": b["mouthFunnel"],
        "LipPuckerUpper": b["mouthPucker"],
        "LipSuckLower": b["mouthRollLower"],
        "MouthOpen": sum(b[f"{n}{s}"] for n in ("mouthUpperUp", "mouthLowerDown") for s in smile) / 4,
        "MouthUpperUp": (b["mouthUpperUpLeft"] + b["mouthUpperUpRight"]) / 2,
        "NoseSneer": (b["noseSneerLeft"] + b["noseSneerRight"]) / 2,
        "EyeLeftX": 0.2 / math.radians(45),
        "EyeLeftY": 0.1 / math.radians(45),
        "EyeX": 0.3 / math.radians(45),
    }
    found = {name: sent[f"/avatar/parameters/v2/{name}"] for name in expected}
    assert found == pytest.approx(expected, abs=1e-5)


def test_vrchats_own_eye_tracking_is_in_degrees_down_and_right() -> None:
    values = values_by_address(VrchatPackets(ARKIT)(WEIGHTS, ROTATION))
    (shut,) = values["/tracking/eye/EyesClosedAmount"]
    assert shut[0] == pytest.approx((BY_NAME["eyeBlinkLeft"] + BY_NAME["eyeBlinkRight"]) / 2, abs=1e-6)
    (angles,) = values["/tracking/eye/LeftRightPitchYaw"]
    assert angles == pytest.approx([math.degrees(a) for a in (-0.1, 0.2, 0.05, 0.4)], abs=1e-4)


def test_only_what_is_asked_for_is_sent() -> None:
    addresses = set(values_by_address(VrchatPackets(ARKIT, ["eyes"])(WEIGHTS, None)))
    assert {address for address in addresses if not address.endswith("Active")} == {
        "/tracking/eye/EyesClosedAmount",
        "/tracking/eye/LeftRightPitchYaw",
    }
    own = VrchatPackets(["Mouth_1"], ["own"])
    assert values_by_address(own(torch.tensor([0.5]), None))["/avatar/parameters/Mouth_1"] == [(0.5,)]
    with pytest.raises(ShapeError, match="found weights"):
        own(torch.zeros(2), None)
    with pytest.raises(NameMismatchError, match="which OSC addresses cannot hold"):
        VrchatPackets(["Mouth 1"], ["own"])
