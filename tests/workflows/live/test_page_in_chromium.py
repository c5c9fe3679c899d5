"""The live page in Chromium with a planted session behind it."""

import io
import json
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from headless_chromium import until
from PIL import Image
from planted_faces import JAW, Desk, Endless, ShadeSolver
from websockets.sync.client import connect

from torchface import BlendshapeRig, save_rig
from torchface.errors import MissingExtraError
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.weights.live_link_csv import load_live_link
from torchface.progress import silent
from torchface.workflows.browser_app.built_page import built_page
from torchface.workflows.live import live_anybody
from torchface.workflows.live.live_anybody import LiveSettings, go_live
from torchface.workflows.live.live_session import LiveSession
from torchface.workflows.live.page_server import PageServer


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
