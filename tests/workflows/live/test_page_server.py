"""The live page's server: who gets what."""

import json
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from headless_chromium import until
from planted_faces import FRONTAL, Desk
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from torchface.errors import FileFormatError
from torchface.workflows.live.live_view import FRAME, PICTURE
from torchface.workflows.live.page_server import PageServer, Preparing


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture
def server(desk: Desk, tmp_path: Path) -> Iterator[PageServer]:
    (tmp_path / "assets").mkdir()
    (tmp_path / "index.html").write_text('<html data-engine="browser">')
    (tmp_path / "assets" / "page.js").write_text("1")

    def takes(name: str) -> bytes:
        if name != "one two":
            raise FileFormatError(f"found no take {name}")
        return b"rows"

    running = PageServer(tmp_path, {"character.glb": b"glb"}, takes, desk, 0)
    yield running
    running.stop()


def got(url: str, **headers: str) -> tuple[int, bytes, str]:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10) as answer:
            return answer.status, answer.read(), answer.headers["Content-Type"]
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers["Content-Type"]


def test_the_page_needs_its_token_and_the_stream_view_does_not(server: PageServer) -> None:
    root = f"http://127.0.0.1:{server.port}"
    page = (200, b'<html data-engine="server">', "text/html; charset=utf-8")
    assert got(server.url) == page
    assert got(server.stream_url + "?background=00ff00") == page
    assert got(f"{root}/assets/page.js")[::2] == (200, "text/javascript; charset=utf-8")
    assert got(f"{root}/character.glb") == (200, b"glb", "model/gltf-binary")
    assert got(f"{server.url}takes/one%20two")[:2] == (200, b"rows")
    assert got(f"{server.url}takes/other")[0] == 404
    for path in ("", "index.html", "wrong/index.html", "takes/one%20two"):
        assert got(f"{root}/{path}")[0] in (403, 404), path
    for path in ("../secret", "assets/../../secret", "%2e%2e/secret", "assets"):
        assert got(f"{root}/{path}")[0] == 404, path
    assert got(server.stream_url, Host="elsewhere.test")[0] == 403
    assert got(server.stream_url, Origin="http://elsewhere.test")[0] == 403


def test_the_pages_socket_gives_frames_pictures_and_state_and_takes_wishes(server: PageServer, desk: Desk) -> None:
    messages: dict[object, bytes | str] = {}
    with connect(server.url.replace("http", "ws") + "socket") as socket:
        for text in ('{"record": true}', "no json", "[1]", json.dumps({"reset": True})):
            socket.send(text)
        while len(messages) < 3:
            message = socket.recv(10)
            messages["state" if isinstance(message, str) else int(np.frombuffer(message, "<u4", 1)[0])] = message
        until(lambda: len(desk.messages) == 2, 10)
        server.stop()
        assert not [one for one in threading.enumerate() if one.name == "torchface-sender"]  # all is said by now
        words = [json.loads(message) for message in socket if isinstance(message, str)]
    assert desk.messages == [{"record": True}, {"reset": True}]  # whose refusal ends nothing
    assert json.loads(messages["state"]) == {"words": "here"}
    assert words[-1]["ended"] == "torchface has ended."
    frame = messages[FRAME]
    assert isinstance(frame, bytes)
    numbers = np.frombuffer(frame, "<f4", offset=16)
    np.testing.assert_allclose(numbers[:52], np.arange(52) / 52, atol=1e-6)
    np.testing.assert_allclose(numbers[52:61], FRONTAL.flatten())
    np.testing.assert_allclose(numbers[61:65], [0.1, 0.2, 0.3, 0.4])
    assert (numbers[65:201] == 7).all()
    np.testing.assert_allclose(numbers[205:], [2, 0, 1, 0.5, 0.01, 9, 64, 48], atol=1e-6)
    assert np.frombuffer(frame, "<f8", 1, 8)[0] == pytest.approx(10, abs=2000)
    small = messages[PICTURE]
    assert isinstance(small, bytes)
    shown = cv2.imdecode(np.frombuffer(small, np.uint8, offset=8), cv2.IMREAD_COLOR)
    assert shown.shape == (48, 64, 3)
    assert np.abs(shown[24, 32].astype(int) - (50, 100, 200)).max() < 8


def test_a_page_says_what_is_made_and_its_settings_and_takes_reach_the_session_then(desk: Desk, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("page")
    told: list[tuple[str, int, int]] = []
    preparing = Preparing(lambda step, done=0, total=0: told.append((step, done, total)))
    server = PageServer(tmp_path, {}, lambda name: b"", preparing, 0)
    try:
        preparing("making the graph", 1, 4)
        assert told == [("making the graph", 1, 4)]
        with connect(server.url.replace("http", "ws") + "socket") as page:
            assert json.loads(page.recv(5)) == {"words": "Making the graph: 1 of 4 parts are ready."}
            page.send(json.dumps({"controls": {"mirror": True}}))
            page.send(json.dumps({"record": True}))
            rows = np.random.default_rng(0).random((3, 66), np.float32)
            page.send(json.dumps({"keep": "mine", "bytes": rows.nbytes}))
            page.send(rows.tobytes())
            until(lambda: preparing.wishes and preparing.takes)
            assert "mine: kept as soon as torchface is ready." in json.loads(page.recv(5))["words"]
            server.attend(desk)
            until(lambda: isinstance(page.recv(5), bytes))
        assert desk.messages == [{"controls": {"mirror": True}}]
        assert [name for name, _ in desk.kept] == ["mine"]
        np.testing.assert_array_equal(desk.kept[0][1], rows)
    finally:
        server.stop()


def test_the_page_hands_takes_over(server: PageServer, desk: Desk) -> None:
    rows = np.random.default_rng(0).random((5000, 66), np.float32)  # more than a message of the stream's socket
    data = rows.tobytes()
    parts = [data[at : at + 2**15] for at in range(0, len(data), 2**15)]
    with connect(server.url.replace("http", "ws") + "socket") as socket:
        for wrong in (b"", b"row", '{"keep": "a"}', '{"keep": "a", "bytes": 7}', '{"keep": "a", "bytes": 1e12}'):
            socket.send(wrong)
        socket.send(json.dumps({"keep": "left off", "bytes": len(data)}))
        socket.send(parts[0])
        socket.send(json.dumps({"keep": "Prüfung", "bytes": len(data)}))
        for part in parts:
            socket.send(part)
        until(lambda: desk.kept, 10)
    assert [name for name, _ in desk.kept] == ["Prüfung"]
    np.testing.assert_array_equal(desk.kept[0][1], rows)


def test_a_pose_ends_with_the_page_that_has_asked_for_it_and_with_no_other(server: PageServer, desk: Desk) -> None:
    first, other, last = ({"controls": {"solver": {"pose": pose}}} for pose in (2, 0, 3))
    address = server.url.replace("http", "ws") + "socket"
    with connect(address, max_queue=None) as posing:
        posing.send(json.dumps(first))
        until(lambda: desk.messages, 10)
        with connect(address, max_queue=None) as page:
            page.send(json.dumps(other))
            page.send(json.dumps({"reset": True}))
            until(lambda: len(desk.messages) == 2, 10)
        until(lambda: len([one for one in threading.enumerate() if one.name == "torchface-sender"]) == 1, 10)
        posing.send(json.dumps(last))
        until(lambda: len(desk.messages) == 3, 10)
        assert not desk.closed
    until(lambda: desk.closed, 10)
    assert desk.messages == [first, {"reset": True}, last]


def test_the_streams_socket_gives_frames_alone_and_takes_nothing(server: PageServer, desk: Desk) -> None:
    with connect(f"ws://127.0.0.1:{server.port}/socket") as socket:
        socket.send('{"record": true}')
        kinds = {
            np.frombuffer(message, "<u4", 1)[0] for _ in range(60) if isinstance(message := socket.recv(10), bytes)
        }
    assert kinds == {FRAME}
    assert desk.messages == []
    with pytest.raises(InvalidStatus, match="403"):
        connect(f"ws://127.0.0.1:{server.port}/socket", origin="http://elsewhere.test")
