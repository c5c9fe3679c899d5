"""VTube Studio's plug-in API, answered by a server written from its documentation."""

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
import torch
from websockets.sync.server import ServerConnection, serve

from torchface.errors import ValueRangeError
from torchface.io.protocols.vtube_studio import VTubeStudioSender, parameters
from torchface.io.protocols.weight_sender import open_sender
from torchface.shape_names import ARKIT

TOKEN = "adcd-123-ef09"
TAKEN = {"CheekPuff", "TongueOut"}  # parameters that every model has


class Studio:
    """Answers requests as the documentation says; keeps what was injected."""

    def __init__(self, allow: bool = True, token: str = TOKEN) -> None:
        self.allow, self.token = allow, token
        self.asked = 0
        self.injected: list[dict[str, float]] = []
        self.made: list[str] = []
        self.authenticated = False

    def handle(self, socket: ServerConnection) -> None:
        self.authenticated = False
        for text in socket:
            request = json.loads(text)
            assert request["apiName"] == "VTubeStudioPublicAPI"
            assert request["apiVersion"] == "1.0"
            assert 1 <= len(request["requestID"]) <= 64
            kind, data = self.answer(request["messageType"], request.get("data", {}))
            head = {"apiName": "VTubeStudioPublicAPI", "apiVersion": "1.0", "timestamp": 1625405710728}
            event = {**head, "requestID": "other", "messageType": "ModelLoadedEvent", "data": {}}
            socket.send(json.dumps(event))  # what nobody asked for comes between
            socket.send(json.dumps({**head, "requestID": request["requestID"], "messageType": kind, "data": data}))

    def answer(self, kind: str, data: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        if kind == "AuthenticationTokenRequest":
            self.asked += 1
            assert 3 <= len(data["pluginName"]) <= 32
            assert 3 <= len(data["pluginDeveloper"]) <= 32
            if not self.allow:
                return "APIError", {"errorID": 50, "message": "User has denied API access for your plugin."}
            return "AuthenticationTokenResponse", {"authenticationToken": self.token}
        if kind == "AuthenticationRequest":
            self.authenticated = data["authenticationToken"] == self.token and self.allow
            return "AuthenticationResponse", {"authenticated": self.authenticated, "reason": "Token invalid."}
        if not self.authenticated:
            return "APIError", {"errorID": 8, "message": "Not authenticated."}
        if kind == "ParameterCreationRequest":
            name = data["parameterName"]
            assert 4 <= len(name) <= 32
            assert name.isalnum()
            if name in TAKEN:
                return "APIError", {"errorID": 352, "message": "Default parameter."}
            self.made.append(name)
            return "ParameterCreationResponse", {"parameterName": name}
        assert kind == "InjectParameterDataRequest"
        assert data["mode"] == "set"
        self.injected.append({value["id"]: value["value"] for value in data["parameterValues"]})
        return "InjectParameterDataResponse", {}


@contextmanager
def running(studio: Studio, port: int = 0) -> Iterator[int]:
    with serve(studio.handle, "127.0.0.1", port) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.socket.getsockname()[1]
        finally:
            server.shutdown()
            thread.join(5)


def opened(port: int, token: Path) -> closing[VTubeStudioSender]:
    return closing(VTubeStudioSender("vts", "127.0.0.1", port, ARKIT, token))


def until(happened: Callable[[], bool]) -> None:
    end = time.monotonic() + 10
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_user_allows_once_and_frames_arrive(tmp_path: Path) -> None:
    studio, token = Studio(), tmp_path / "token.txt"
    weights = torch.zeros(52)
    weights[ARKIT.index("jawOpen")] = 0.5
    weights[ARKIT.index("mouthSmileLeft")] = 0.25
    for _ in range(2):
        with (
            running(studio) as port,
            closing(open_sender(f"vts://127.0.0.1:{port}?token={token}", ARKIT, 60.0)) as sender,
        ):
            studio.injected.clear()
            until(lambda s=sender: s.send(weights, torch.tensor([0.1, 0.2, 0.3] + [0.0] * 6)))
            until(lambda: bool(studio.injected))
    assert studio.asked == 1  # the token was kept
    assert token.read_text() == TOKEN
    assert token.stat().st_mode & 0o077 == 0
    values = studio.injected[-1]
    assert values["JawOpen"] == 0.5
    assert values["MouthOpen"] == 0.75
    assert values["MouthSmile"] == pytest.approx(0.5 + 0.25 / 4)
    assert values["FaceAngleX"] == pytest.approx(math.degrees(0.1), abs=1e-4)
    assert values["FaceAngleY"] == pytest.approx(-math.degrees(0.2), abs=1e-4)
    assert values["EyeOpenLeft"] == 0.75
    assert len(set(studio.made)) == 52 - len(TAKEN)
    assert set(studio.made) <= set(values)


def test_a_refusal_is_said_and_not_asked_for_again(tmp_path: Path) -> None:
    studio = Studio(allow=False)
    with running(studio) as port, opened(port, tmp_path / "token") as sender:
        until(lambda: "User has denied API access" in sender.problem)
        sender._thread.join(5)
        assert not sender.send(torch.zeros(52))
    assert studio.asked == 1
    assert not (tmp_path / "token").exists()


def test_a_token_that_was_revoked_is_asked_for_again(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("old-token")
    studio = Studio()
    with running(studio) as port, opened(port, tmp_path / "token") as sender:
        until(lambda: sender.send(torch.zeros(52)))
    assert (tmp_path / "token").read_text() == TOKEN


def test_nobody_there_costs_no_time_and_who_comes_later_gets_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchface.io.protocols.vtube_studio._RETRY", 0.05)
    with running(Studio()) as port:
        pass
    with opened(port, tmp_path / "token") as sender:
        begun = time.perf_counter()
        for _ in range(100):
            assert not sender.send(torch.zeros(52))
        assert time.perf_counter() - begun < 1.0
        until(lambda: "not connected (nobody answers: open VTube Studio" in sender.problem)
        studio = Studio()
        with running(studio, port):
            until(lambda: sender.send(torch.zeros(52)))
            until(lambda: bool(studio.injected))


@pytest.mark.parametrize(
    "answer", ["", "[]", "null", '{"data": 5}', "[" * 5000, '{"requestID": "torchface-1", "data": {}}']
)
def test_answers_that_are_none_end_in_words(answer: str, tmp_path: Path) -> None:
    def handle(socket: ServerConnection) -> None:
        for _ in socket:
            socket.send(answer)

    studio = Studio()
    studio.handle = handle
    with running(studio) as port, opened(port, tmp_path / "token") as sender:
        until(lambda: sender.problem.startswith(("not connected (", "found a token of 0 letters")))
        assert not sender.send(torch.zeros(52))


def test_values_stay_within_their_ranges() -> None:
    for weights in (torch.zeros(52), torch.ones(52)):
        values = parameters(weights, torch.full((9,), 0.5))
        assert all(-1 <= value <= 1 for name, value in values.items() if not name.startswith("FaceAngle"))
    with pytest.raises(ValueRangeError, match=r"whose token's folder .* does not exist"):
        open_sender("vts://127.0.0.1?token=/no/such/folder/token", ARKIT, 30.0)
