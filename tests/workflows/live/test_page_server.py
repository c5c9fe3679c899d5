"""The live page's server: who gets what, and the page in Chromium with a planted session behind it."""

import io
import json
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from headless_chromium import until
from PIL import Image
from planted_faces import FRONTAL, JAW, Endless, ShadeSolver
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from torchface.errors import FileFormatError, MissingExtraError, ValueRangeError
from torchface.io import save_rig
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.weights.live_link_csv import load_live_link
from torchface.progress import silent
from torchface.rig import BlendshapeRig
from torchface.workflows.browser_app.built_page import built_page
from torchface.workflows.live import live_anybody
from torchface.workflows.live.live_anybody import LiveSettings, go_live
from torchface.workflows.live.live_frames import LiveFrame
from torchface.workflows.live.live_session import LiveSession
from torchface.workflows.live.live_view import FRAME, PICTURE, LiveView
from torchface.workflows.live.page_server import PageServer, Preparing


class Desk:
    """One moment again and again, and what was asked."""

    def __init__(self) -> None:
        self.messages: list[Mapping[str, Any]] = []
        self.kept: list[tuple[str, np.ndarray]] = []
        self.number, self.closed = 0, False

    def next_view(self, before: LiveView | None, seconds: float) -> LiveView | None:
        time.sleep(0.01)
        self.number += 1
        weights, marks = torch.arange(52) / 52, torch.full((68, 2), 7.0)
        gaze, beside = torch.tensor([[0.1, 0.2], [0.3, 0.4]]), torch.tensor([2.0, 0.0])
        solved = LiveFrame(weights, FRONTAL, marks, gaze=gaze, beside=beside, calibrated=0.5)
        picture = np.full((48, 64, 3), (200, 100, 50), np.uint8)
        return LiveView(self.number / 100, 0.01, 9.0, picture, solved)

    def state(self) -> dict[str, Any]:
        return {"words": "here"}

    def keep(self, name: str, rows: np.ndarray) -> None:
        self.kept.append((name, rows))

    def left(self) -> None:
        self.closed = True

    def asked(self, message: Mapping[str, Any]) -> None:
        self.messages.append(message)
        raise ValueRangeError("nobody may ask")


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
    with connect(address) as posing:
        posing.send(json.dumps(first))
        until(lambda: desk.messages, 10)
        with connect(address) as page:
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


class Steered(Endless):
    """Frames of a shade that the test sets, 25 a second, until it is closed."""

    def __init__(self) -> None:
        super().__init__(1, 25.0)
        self.jaw, self.open = 0.0, True

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        while self.open:
            time.sleep(0.04)
            yield time.perf_counter(), np.full((48, 64, 3), round(40 + 200 * self.jaw), np.uint8)


class Opened:
    """A session in a thread, and its page."""

    def __init__(self, folder: Path, rig: BlendshapeRig, patch: pytest.MonkeyPatch) -> None:
        self.source, self.solver, self.kept = Steered(), ShadeSolver(), folder / "kept"
        save_rig(rig, folder / "dome.glb")
        patch.setattr(live_anybody, "open_source", lambda *_: self.source)
        patch.setattr(live_anybody, "RECORDINGS", self.kept)
        asked: list[Mapping[str, Any]] = []
        self._asked, asking = asked, LiveSession.asked

        def keeping(session: LiveSession, message: Mapping[str, Any]) -> None:
            asking(session, message)
            asked.append(message)

        patch.setattr(LiveSession, "asked", keeping)
        self.urls: list[str] = []
        self.said: list[str] = []
        settings = LiveSettings("0", folder / "dome.glb", port=0)
        live = lambda: go_live(settings, self.said.append, self.urls.append, lambda progress: self.solver)  # noqa: E731
        self._thread = threading.Thread(target=live)
        self._thread.start()
        self.url: str = until(lambda: self.urls and self.urls[0])
        self.stream = until(lambda: [one.split()[-1] for one in self.said if "OBS" in one])[0]
        (folder / "dome.glb").unlink()  # a character that is deleted while it plays is shown and recorded all the same

    @property
    def frozen(self) -> bool:
        """Whether the session does what the page asked for last: to stand still."""
        controls = [message["controls"] for message in self._asked if "controls" in message]
        return bool(controls) and controls[-1]["weights"]["frozen"] is True

    def close(self) -> None:
        self.source.open = False
        self._thread.join(30)


@pytest.fixture(scope="module")
def live(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    try:
        built_page(silent)
    except MissingExtraError as error:
        pytest.skip(f"the page cannot be built here: {error}")
    with pytest.MonkeyPatch.context() as patch:
        opened = Opened(tmp_path_factory.mktemp("live"), dome_rig, patch)
        yield opened
        opened.close()


@pytest.fixture
def page(chromium: Any, live: Opened) -> Any:
    chromium.set_window_size(700, 600)
    chromium.get(live.url)
    until(lambda: chromium.execute_script("return document.documentElement.dataset.running") == "on")
    return chromium


def text(page: Any, name: str) -> str:
    return str(page.execute_script("return document.getElementById(arguments[0]).textContent", name))


def slide(page: Any, name: str, value: float) -> None:
    script = (
        "const e = document.getElementById(arguments[0]); e.value = arguments[1]; e.dispatchEvent(new Event('input'))"
    )
    page.execute_script(script, name, value)


@pytest.mark.browser
def test_settings_reach_the_session_and_are_there_after_a_reload(page: Any, live: Opened) -> None:
    slide(page, "gain", 0.5)
    group = "document.querySelector('[aria-label=\"jaw: dead zone\"]')"
    page.execute_script(f"const e = {group}; e.value = 0.2; e.dispatchEvent(new Event('input'))")
    live.source.jaw = 0.8
    weight = (0.4 - 0.2) / 0.8
    until(lambda: abs(sent_jaw(live) - weight) < 1e-2)
    page.refresh()
    until(lambda: page.execute_script("return document.documentElement.dataset.running") == "on")
    assert page.execute_script("return document.getElementById('gain').value") == "0.5"
    assert page.execute_script(f"return {group}.value") == "0.2"
    slide(page, "gain", 1)
    page.execute_script(f"const e = {group}; e.value = 0; e.dispatchEvent(new Event('input'))")
    until(lambda: abs(sent_jaw(live) - 0.8) < 1e-2)
    page.find_element("id", "freeze").click()
    until(lambda: live.frozen)
    live.source.jaw = 0.0
    live.solver.controls.clear()
    until(lambda: len(live.solver.controls) > 10)  # frames with the mouth shut
    assert abs(sent_jaw(live) - 0.8) < 1e-2
    page.find_element("tag name", "body").send_keys("f")
    until(lambda: sent_jaw(live) < 1e-2)


def sent_jaw(live: Opened) -> float:
    """The jaw as the stream's socket gives it."""
    with connect(live.stream.replace("http", "ws").replace("stream", "socket")) as socket:
        message = socket.recv(10)
    assert isinstance(message, bytes)
    return float(np.frombuffer(message, "<f4", offset=16)[JAW])


@pytest.mark.browser
def test_takes_are_recorded_played_renamed_and_deleted(page: Any, live: Opened) -> None:
    page.find_element("id", "record").click()
    until(lambda: "frames" in text(page, "recorded") and int(text(page, "recorded").split()[2]) >= 50)
    page.find_element("id", "record").click()
    until((live.kept / "summary.json").exists)
    until(lambda: page.find_elements("css selector", "#takes li"))
    count = len(load_live_link(live.kept / "live_link.csv"))
    assert count > 5
    take = read_gltf_weights(live.kept / "animation.glb")
    assert len(take) == count
    assert f"{count} frames" in text(page, "takes")
    press = "document.querySelector(arguments[0]).click()"  # rows are made anew when the list changes
    page.execute_script(press, "#takes .play")
    until(lambda: "Stop" in text(page, "takes"))
    until(lambda: "Stop" not in text(page, "takes"))
    page.execute_script(press, "#takes .play")
    until(lambda: "Stop" in text(page, "takes"))
    renamed = "e.value = 'The <b>first</b>'; e.dispatchEvent(new Event('change'))"
    page.execute_script(f"const e = document.querySelector('#takes .name'); {renamed}")
    until(lambda: json.loads((live.kept / "summary.json").read_text()).get("name") == "The <b>first</b>")
    until(lambda: page.execute_script("return document.querySelector('#takes .name').value") == "The <b>first</b>")
    assert "Stop" in text(page, "takes")  # a take with another name plays on, and its new row stops it
    page.execute_script(press, "#takes .play")
    assert "Stop" not in text(page, "takes")
    page.execute_script(press, "#takes .play")
    until(lambda: "Stop" in text(page, "takes"))
    page.execute_script(press, "#takes .delete")
    until(lambda: not page.find_elements("css selector", "#takes li"))
    assert not live.kept.exists()
    assert page.execute_script("return document.getElementById('problem').hidden")


@pytest.mark.bench
@pytest.mark.browser
def test_a_calibration_gives_the_solver_the_poses_that_are_seen(page: Any, live: Opened) -> None:
    live.source.jaw = 0.0
    live.solver.controls.clear()
    page.find_element("id", "calibrate").click()
    until(lambda: "2 of 6: Open your mouth wide" in text(page, "prompt-words"))
    live.source.jaw = 0.8
    until(lambda: "3 of 6" in text(page, "prompt-words"))
    poses = [one.pose for one in live.solver.controls]
    assert {1, 2} <= set(poses)
    page.find_element("id", "prompt-stop").click()
    live.source.jaw = 0.0


@pytest.mark.bench
@pytest.mark.browser
def test_the_stream_view_shows_the_character_alone_on_its_colour(chromium: Any, live: Opened) -> None:
    live.source.jaw = 0.0
    chromium.get(f"{live.stream}?background=00ff00&size=200x160")

    def shot() -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO(chromium.get_screenshot_as_png())).convert("RGB"), int)

    def drawn() -> np.ndarray:
        return np.abs(shot() - (0, 255, 0)).max(2) > 40

    until(lambda: drawn().any())
    mask = drawn()
    rows, columns = np.nonzero(mask)
    assert rows.max() < 160
    assert columns.max() < 200
    assert mask.sum() > 1000
    before = shot()
    live.source.jaw = 1.0
    until(lambda: np.abs(shot() - before).max() > 40)
    live.source.jaw = 0.0


@pytest.mark.browser
@pytest.mark.usefixtures("live")  # which builds the page
def test_the_stream_view_goes_on_when_torchface_is_started_again(
    chromium: Any, dome_rig: BlendshapeRig, tmp_path: Path
) -> None:
    save_rig(dome_rig, tmp_path / "dome.glb")
    files = {"character.glb": (tmp_path / "dome.glb").read_bytes()}

    def shows() -> bool:
        return bool(chromium.execute_script("return document.documentElement.dataset.running") == "on")

    first = PageServer(built_page(silent), files, lambda name: b"", Desk(), 0)
    chromium.get(first.stream_url)
    until(shows)
    first.stop()
    until(lambda: not shows())
    second = PageServer(built_page(silent), files, lambda name: b"", Desk(), first.port)
    until(shows)
    second.stop()


@pytest.mark.browser
def test_the_end_is_said(page: Any, live: Opened) -> None:
    live.source.open = False
    until(lambda: text(page, "status").startswith("planted has ended after"), 60)
