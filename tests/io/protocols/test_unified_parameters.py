"""What parameters of Unified Expressions say of a face: each comes back by itself, and faces by their sums alone."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from osc_receiver import values_by_address

from torchface.io.protocols.osc_messages import osc_bundles, osc_message
from torchface.io.protocols.osc_packets import OscReader
from torchface.io.protocols.received_face import ReceivedFace
from torchface.io.protocols.unified_parameters import COMBINED
from torchface.io.protocols.vrchat_packets import VrchatPackets
from torchface.shape_names import ARKIT, UNIFIED

PARAMETERS = "/avatar/parameters/v2/"
NAMES = [name for twins in UNIFIED.twins.values() for name in twins]
NAMES += [
    *COMBINED,
    "EyeWide",
    "EyeSquint",
    "EyeX",
    "EyeY",
    *(f"Eye{side}{axis}" for side in ("Left", "Right") for axis in "XY"),
]


def sent(weights: torch.Tensor, rotations: torch.Tensor | None) -> dict[str, float]:
    values = values_by_address(VrchatPackets(ARKIT, ["unified"])(weights, rotations))
    return {address.removeprefix(PARAMETERS): value for address, ((value,),) in values.items() if PARAMETERS in address}


def received(parameters: dict[str, float], unused: dict[str, None] | None = None) -> ReceivedFace:
    messages = [osc_message(PARAMETERS + name, value) for name, value in parameters.items()]
    return OscReader("", unused)(osc_bundles(messages)[0])[-1]


def face(**weights: float) -> torch.Tensor:
    return torch.tensor([weights.get(name, 0.0) for name in ARKIT])


@given(st.integers(0, 2**16), st.sampled_from(NAMES))
def test_each_parameter_alone_gives_a_face_that_has_it(seed: int, name: str) -> None:
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(52, generator=generator)
    values = sent(weights, 1.4 * torch.rand(9, generator=generator) - 0.7)
    back = received({name: values[name]})
    assert sent(back.weights, back.rotations)[name] == pytest.approx(values[name], abs=1e-5)


@pytest.mark.parametrize(
    "weights",
    [
        {"mouthSmileLeft": 0.6, "mouthFrownRight": 0.3},
        {"eyeBlinkLeft": 0.75, "eyeWideRight": 0.5},
        {"jawLeft": 0.5, "jawForward": 0.25, "mouthRight": 0.5},
        {"browInnerUp": 0.5, "browOuterUpLeft": 0.5, "browOuterUpRight": 0.5},
        {"browDownLeft": 0.5, "cheekPuff": 0.25},
        {"mouthFunnel": 0.5, "noseSneerLeft": 0.3, "noseSneerRight": 0.3},
    ],
    ids=lambda weights: "+".join(weights),
)
def test_a_face_comes_back_from_sums_alone(weights: dict[str, float]) -> None:
    values = sent(face(**weights), None)
    back = received({name: values[name] for name in COMBINED})
    torch.testing.assert_close(back.weights, face(**weights), atol=1e-6, rtol=0.0)


def test_lids_gaze_and_what_has_fewer_expressions_counts_more() -> None:
    lids = received({"EyeLidLeft": 0.25, "EyeLidRight": 0.9, "SmileFrown": -0.5, "MouthSmileLeft": 0.5, "EyeY": -0.5})
    assert lids.weights[ARKIT.index("eyeBlinkLeft")] == pytest.approx(2 / 3)
    assert lids.weights[ARKIT.index("eyeWideRight")] == pytest.approx(0.6)
    assert lids.weights[ARKIT.index("mouthSmileLeft")] == 0.5
    assert lids.weights[ARKIT.index("mouthFrownRight")] == 0.5
    assert lids.weights[ARKIT.index("eyeLookDownLeft")] == 0.5
    assert lids.rotations.tolist() == pytest.approx([0, 0, 0, 0, math.radians(22.5), 0, 0, math.radians(22.5), 0])


def test_vrchats_eye_tracking_comes_back() -> None:
    rotations = torch.tensor([0.0, 0.0, 0.0, 0.2, -0.1, 0.0, 0.4, 0.05, 0.0])
    found = [
        OscReader()(p) for p in VrchatPackets(ARKIT, ["eyes"])(face(eyeBlinkLeft=0.5, eyeBlinkRight=0.5), rotations)
    ]
    torch.testing.assert_close(found[-1][-1].weights, face(eyeBlinkLeft=0.5, eyeBlinkRight=0.5))
    torch.testing.assert_close(found[-1][-1].rotations, rotations)


def test_addresses_that_move_nothing_are_kept_once() -> None:
    unused: dict[str, None] = {}
    for _ in range(2):
        received({"TongueX": 0.5, "CheekSuckLeft": 0.5, "JawOpen": 0.5, "Wing": 1.0}, unused)
    assert list(unused) == [PARAMETERS + name for name in ("TongueX", "CheekSuckLeft", "Wing")]
    (packet,) = VrchatPackets(ARKIT, ["arkit"])(face(jawOpen=1.0), None)[-1:]
    nothing: dict[str, None] = {}
    OscReader("", nothing)(packet)
    assert not nothing
