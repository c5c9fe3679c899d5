"""The live page as a user meets it: the character moves with the camera, and every button does what it says."""

import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from headless_chromium import until
from planted_faces import JAW, Endless, ShadeSolver

from torchface.io import load_take, save_rig
from torchface.rig import BlendshapeRig
from torchface.viz.browser import live_page
from torchface.viz.browser.live_page import camera_drawing
from torchface.viz.browser.live_view import LiveView
from torchface.workflows.live import live_anybody
from torchface.workflows.live.live_anybody import LiveSettings, go_live

_HEIGHT = """
const node = window.__viserMutable && window.__viserMutable.nodeRefFromName['/head/part0'];
let lowest = null;
if (node) node.traverse(x => { if (x.isMesh && lowest === null && x.geometry.attributes.position) {
    const p = x.geometry.attributes.position.array; lowest = 1e9;
    for (let i = 1; i < p.length; i += 3) lowest = Math.min(lowest, p[i]); } });
return lowest;
"""
_THUMB = """
const label = [...document.querySelectorAll('label')].find(e => e.textContent.trim() === arguments[0]);
return label ? document.getElementById(label.getAttribute('for')).querySelector('[role=slider]') : null;
"""


class Slow(Endless):
    """Frames that come slowly and say that they come twelve a second, until it is closed; their shade is the jaw's."""

    def __init__(self) -> None:
        super().__init__(1, 12.0)
        self.jaw, self.open, self.stepped = 0.0, True, False
        self.steps = threading.Semaphore(0)  # while it is stepped a frame comes for each release
        self.begin = threading.Event()  # a browser without a graphics card loads a page slowly that moves already

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        number = 0
        self.begin.wait(300)
        while self.open:
            if self.stepped and not self.steps.acquire(timeout=1):
                continue
            number += 1
            time.sleep(0 if self.stepped else 0.04)
            yield number / 12, np.full((48, 64, 3), round(40 + 200 * self.jaw), np.uint8)


class Opened:
    """A session in a thread, with its page."""

    def __init__(self, folder: Path, rig: BlendshapeRig, patch: pytest.MonkeyPatch) -> None:
        self.source, self.solver, self.folder = Slow(), ShadeSolver(), folder
        save_rig(rig, folder / "balls.glb")
        patch.setattr(live_anybody, "open_source", lambda *_: self.source)
        patch.setattr(live_anybody, "shipped_detector", lambda: lambda picture: ())
        patch.setattr(live_anybody, "RECORDINGS", folder / "kept")
        patch.setattr(live_page, "_RATE", 5.0)  # a browser without a graphics card, beside other tests
        self.urls: list[str] = []
        settings = LiveSettings("0", folder / "balls.glb", port=0)
        self.ended: list[Any] = []
        self._thread = threading.Thread(
            target=lambda: self.ended.append(go_live(settings, print, self.urls.append, lambda source: self.solver))
        )
        self._thread.start()
        self.url: str = until(lambda: self.urls and self.urls[0])

    def close(self) -> None:
        self.source.open = False
        self.source.begin.set()
        self._thread.join(30)


@pytest.fixture(scope="module")
def live(chromium: Any, ball_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    with pytest.MonkeyPatch.context() as patch:
        opened = Opened(tmp_path_factory.mktemp("live"), ball_rig, patch)
        chromium.get(opened.url)
        until(lambda: chromium.execute_script(_HEIGHT) is not None)
        opened.source.begin.set()
        yield opened
        opened.close()
        chromium.get("about:blank")


def words(chromium: Any) -> str:
    return str(chromium.execute_script("return document.body.innerText"))


def click(chromium: Any, label: str) -> None:
    button = until(lambda: chromium.find_elements("xpath", f"//button[contains(., '{label}')]"))[0]
    chromium.execute_script("arguments[0].click()", button)


@pytest.mark.browser
def test_the_character_moves_with_the_camera_and_by_the_gain(chromium: Any, live: Opened) -> None:
    from selenium.webdriver.common.keys import Keys

    rest = chromium.execute_script(_HEIGHT)
    assert rest == pytest.approx(-90, abs=0.5)
    live.source.jaw = 0.5  # the lowest point goes 0.5 of 70 mm down
    until(lambda: chromium.execute_script(_HEIGHT) == pytest.approx(-125, abs=1))
    assert "Your face is followed" in words(chromium)
    assert "jawOpen" in words(chromium)
    knob = until(lambda: chromium.execute_script(_THUMB, "Gain"))
    knob.send_keys(Keys.ARROW_LEFT * 10)  # to half
    until(lambda: chromium.execute_script(_HEIGHT) == pytest.approx(-107.5, abs=1))
    knob.send_keys(Keys.ARROW_RIGHT * 10)
    live.source.jaw = 0.0
    until(lambda: chromium.execute_script(_HEIGHT) == pytest.approx(-90, abs=1))


@pytest.mark.browser
def test_the_calibrate_button_goes_through_its_faces(chromium: Any, live: Opened) -> None:
    def steps_to(prompt: str) -> bool:
        live.source.steps.release()  # time goes on as often as the page is looked at, however slow that is
        return prompt in words(chromium)

    live.source.stepped = True
    click(chromium, "Calibrate")
    for prompt in ("1 of 5: Look into the camera", "2 of 5: Open your mouth", "5 of 5: Shut your eyes"):
        until(partial(steps_to, prompt))
    until(lambda: steps_to("100 %") and "of 5" not in words(chromium))
    live.source.stepped = False
    click(chromium, "Forget this person")
    until(lambda: live.solver.resets == 1)


@pytest.mark.browser
def test_the_record_button_leaves_files(chromium: Any, live: Opened) -> None:
    click(chromium, "Start recording")
    click(chromium, "Stop recording")
    until((live.folder / "kept" / "animation.glb").exists)
    assert load_take(live.folder / "kept" / "live_link.csv").weights is not None


def a_view(seen: bool = True, prompt: str = "") -> LiveView:
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:, :32] = 200  # bright on the left
    landmarks = torch.full((68, 2), torch.nan)
    landmarks[0] = torch.tensor([50.0, 10.0])
    weights = torch.zeros(52)
    weights[JAW] = 1.0
    return LiveView(
        picture, landmarks, torch.full((2, 2), torch.nan), weights, torch.eye(3), seen, "", 30.0, 9.0, 0.5, prompt, 1.0
    )


def test_the_picture_is_a_mirrors_with_its_landmarks() -> None:
    plain, mirrored = camera_drawing(a_view(), False), camera_drawing(a_view(), True)
    assert plain.shape == (360, 480, 3)
    assert plain[300, 100].tolist() == [200, 200, 200]
    assert mirrored[300, 100].tolist() == [0, 0, 0]
    # A landmark at x 50 of 64 lies at (50.5 / 64) of the width, or as far from the other side.
    for drawn, x in ((plain, 480 * 50.5 / 64), (mirrored, 480 - 480 * 50.5 / 64)):
        rows, columns = np.nonzero((drawn[..., 2].astype(int) - drawn[..., 0]) > 60)
        assert columns.mean() == pytest.approx(x - 0.5, abs=0.7)
        assert rows.mean() == pytest.approx(360 * 10.5 / 48 - 0.5, abs=0.7)


def test_a_lost_face_dims_the_picture_and_a_prompt_frames_it() -> None:
    assert camera_drawing(a_view(seen=False), False)[300, 100, 0] == 150
    framed = camera_drawing(a_view(prompt="1 of 5"), False)
    assert framed[1, 200].tolist() == framed[-2, 200].tolist() == [46, 92, 138]
