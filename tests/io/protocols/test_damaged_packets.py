"""Readers of packets on damaged and built ones: faces with sane numbers, or an error of ours, at once."""

import json
import os
import random
import time
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mutation import mutated

from torchface.errors import TorchfaceError
from torchface.io.protocols.ifacialmocap_packets import IFacialMocapPackets, read_ifacialmocap
from torchface.io.protocols.live_link_packets import LiveLinkPackets, read_live_link
from torchface.io.protocols.osc_packets import OscPackets, OscReader
from torchface.io.protocols.received_face import ReceivedFace
from torchface.io.protocols.vmc_packets import VmcPackets, VmcReader
from torchface.io.protocols.vrchat_packets import VrchatPackets
from torchface.io.protocols.vtube_studio import _Calls, _RefusedError
from torchface.shape_names import ARKIT

CASES = int(os.environ.get("TORCHFACE_FUZZ_CASES", "100"))
WEIGHTS, ROTATIONS = torch.arange(52) / 64, torch.arange(9) / 16
Read = Callable[[bytes], list[ReceivedFace]]

PROTOCOLS: dict[str, tuple[Callable[[], Read], list[bytes]]] = {
    "livelink": (lambda: read_live_link, LiveLinkPackets(ARKIT, 60.0)(WEIGHTS, ROTATIONS)),
    "ifacialmocap": (lambda: read_ifacialmocap, IFacialMocapPackets(ARKIT)(WEIGHTS, ROTATIONS)),
    "vmc": (VmcReader, VmcPackets(ARKIT)(WEIGHTS, ROTATIONS)),
    "osc": (OscReader, OscPackets(ARKIT)(WEIGHTS, ROTATIONS)),
    "unified": (OscReader, VrchatPackets(ARKIT)(WEIGHTS, ROTATIONS)),
}


def check(read: Read, packet: bytes) -> bool:
    """Whether a packet is read; else an error of ours refuses it."""
    try:
        faces = read(packet)
    except TorchfaceError as error:
        assert len(str(error)) < 1000  # noqa: PT017
        return False
    for face in faces:
        assert face.weights.shape == (52,)
        assert face.rotations.shape == (9,)
        assert float(face.weights.abs().max()) <= 5
        assert float(face.rotations.abs().max()) <= 2 * torch.pi + 1e-6
    return True


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_mutated_packet_is_a_face_or_refused(protocol: str) -> None:
    make, seeds = PROTOCOLS[protocol]
    read, generator, understood = make(), random.Random(0), 0
    assert all(check(read, seed) for seed in seeds)
    begun = time.process_time()
    for number in range(CASES):
        if number % 100 == 0:
            read = make()
        understood += check(read, mutated(generator.choice(seeds), generator)[:65536])
    assert 0 < understood < CASES
    assert time.process_time() - begun < 5 + 0.01 * CASES


@pytest.mark.parametrize("protocol", PROTOCOLS)
@given(data=st.data())
def test_a_built_packet_is_a_face_or_refused(protocol: str, data: st.DataObject) -> None:
    make, seeds = PROTOCOLS[protocol]
    seed = data.draw(st.sampled_from(seeds))
    at, length = data.draw(st.integers(0, len(seed))), data.draw(st.integers(0, 40))
    check(make(), seed[:at] + data.draw(st.binary(max_size=40)) + seed[at + length :])


def test_a_mutated_answer_of_vtube_studio_is_taken_or_refused() -> None:
    head = {"apiName": "VTubeStudioPublicAPI", "apiVersion": "1.0", "requestID": "torchface-1"}
    good = [
        json.dumps(
            {**head, "messageType": "AuthenticationResponse", "data": {"authenticated": True, "reason": "valid"}}
        ),
        json.dumps({**head, "messageType": "APIError", "data": {"errorID": 50, "message": "denied"}}),
    ]
    generator, taken = random.Random(0), 0
    for _ in range(CASES):
        answers = [mutated(generator.choice(good).encode(), generator)]

        def receive(seconds: float, left: list[bytes] = answers) -> bytes:
            if not left:
                raise ValueError("no more")
            return left.pop()

        try:
            _Calls(lambda text: None, receive)("AuthenticationRequest", {}, 0.1)
            taken += 1
        except (ValueError, _RefusedError):
            continue
    assert 0 < taken < CASES
