"""The app in a real Chromium whose camera is a film: what it records, what it says, and that nothing leaves it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from app_browser import WINDOW, Open, Page, elsewhere, film_camera, static_host
from film import planted_film, write_y4m
from headless_chromium import headless_chromium, until
from planted_graph import BLOCK, COLUMNS
from recorded_take import Recorded, allow_camera, assert_same_weights, watch, watched
from test_gltf_viewers import assert_valid, node  # noqa: F401  (its packages)

from torchface.io import load_rig, load_take
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.weights.live_link_csv import load_live_link
from torchface.shape_names import ARKIT
from torchface.workflows.head_rotations import head_angles

pytestmark = pytest.mark.browser
BROWSERS_OWN = ("google.com", "googleapis.com", "gstatic.com", "gvt1.com", "duckduckgo.com")
"""Where Chromium calls by itself, whatever page is open."""


def test_recorded_weights_are_those_of_onnx_runtime_in_python(app: Path, recorded: Recorded) -> None:
    """On the very pixels and intervals that the page gave its worker."""
    assert_same_weights(app.parent / "planted.onnx", recorded, 1e-5)
    rows = load_take(recorded.csv).weights
    answers = np.array([one["weights"] for one in recorded.recorded])
    np.testing.assert_allclose(rows.values[..., 0], answers, rtol=0, atol=1e-7)
    assert len(answers) > 5
    assert answers.std(0).min() > 0.01  # the film moves every shape


def test_the_csv_has_the_cameras_times_and_the_heads_rotation(recorded: Recorded) -> None:
    take = load_live_link(recorded.csv)
    steps = np.array([one["interval"] for one in recorded.recorded[1:]])
    clocks = [[float(part) for part in text.split(":")] for text in take.timecode]
    seconds = np.array([3600 * h + 60 * m + s + frame / 60 for h, m, s, frame in clocks])
    np.testing.assert_allclose(np.diff(seconds), steps, rtol=0, atol=1e-3)
    rotations = torch.tensor([one["rotation"] for one in recorded.recorded], dtype=torch.float64).reshape(-1, 3, 3)
    columns = take.extras["columns"]
    found = torch.stack([columns[f"Head{axis}"] for axis in ("Yaw", "Pitch", "Roll")], dim=1)
    torch.testing.assert_close(found, head_angles(rotations), rtol=0, atol=1e-6)
    assert found[:, 0].std() > 0.05
    # Planted: both eyes 0.1 to the person's left and 0.05 up, which the app's recordings have as negative.
    assert (columns["LeftEyeYaw"] + 0.1).abs().max() < 1e-6
    assert (columns["RightEyePitch"] + 0.05).abs().max() < 1e-6


def test_the_glb_has_the_recording_as_its_animation(character: Path, recorded: Recorded) -> None:
    take, told = read_gltf_weights(recorded.glb), load_live_link(recorded.csv)
    rig, before = load_rig(recorded.glb), load_rig(character)
    torch.testing.assert_close(rig.deltas, before.deltas)
    assert take.weights.names == rig.names == before.names
    column = {name: i for i, name in enumerate(ARKIT)}
    source = {"mouthSmile_L": "mouthSmileLeft", "mouthSmile_R": "mouthSmileRight", "EyeBlinkLeft": "eyeBlinkLeft"}
    for i, name in enumerate(rig.names):
        values = take.weights.values[:, i, 0]
        if name == "antenna":
            assert not values.any()
            continue
        arkit = source.get(name, name.removesuffix("_L").removesuffix("_R"))
        torch.testing.assert_close(values, told.weights.values[:, column[arkit], 0], rtol=0, atol=1e-6)


def test_khronos_validator_finds_nothing_in_the_glb(recorded: Recorded, node: str) -> None:  # noqa: F811
    assert_valid(node, recorded.glb)


def test_only_files_of_the_page_were_asked_for(opened: Open, recorded: Recorded) -> None:
    assert {method for method, _ in opened.host.requests} == {"GET"}
    paths = {path for _, path in opened.host.requests}
    known = ("/index.html", "/webcam.graph", "/character.glb", "/character.json")
    assert set(known) <= paths
    assert all(path.startswith((*known, "/assets/")) for path in paths)
    strangers = [path for _, path in opened.outside.requests if not any(own in path for own in BROWSERS_OWN)]
    assert strangers == []


FETCH = "fetch('http://elsewhere.test/{}', {{mode: 'no-cors'}}).then(() => 'answered', () => 'refused')"


def test_the_policy_lets_nothing_out_neither_from_the_page_nor_from_its_worker(
    opened: Open, recorded: Recorded
) -> None:
    driver = opened.page.driver

    def asked(code: str) -> str:
        return driver.execute_async_script(f"const done = arguments[0]; ({code}).then(done)")

    in_worker = """new Promise(done => {
        const code = `${FETCH}.then(answer => postMessage(answer))`;
        const worker = new Worker(URL.createObjectURL(new Blob([code], {type: "text/javascript"})), {type: "module"});
        worker.onmessage = ({data}) => done(data); worker.onerror = () => done("refused");
    })"""
    assert asked(FETCH.format("page")) == "refused"
    assert asked(in_worker.replace("${FETCH}", FETCH.format("worker"))) == "refused"
    posted = "fetch('http://elsewhere.test/post', {method: 'POST', mode: 'no-cors', body: 'x'})"
    assert asked(posted + ".then(() => 'answered', () => 'refused')") == "refused"
    driver.execute_script("navigator.sendBeacon('http://elsewhere.test/beacon', 'x')")
    driver.execute_script("new Image().src = 'http://elsewhere.test/picture'")
    driver.execute_async_script("setTimeout(arguments[0], 200)")
    assert not [path for _, path in opened.outside.requests if "elsewhere.test" in path]
    # The app's own worker is of that kind: one loaded from an address would not be under the page's policy.
    # Later ones are of three.js, for textures of characters that other tests open in this page.
    assert watched(opened.page, "watched.workers")[0].startswith("blob:")


@pytest.fixture(scope="module")
def bare(app: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Open]:
    """A Chromium without a camera."""
    folder = tmp_path_factory.mktemp("bare")
    (app / "no_policy.html").write_text("<title>no policy</title>")
    with (
        static_host(app) as host,
        elsewhere() as outside,
        headless_chromium(
            folder / "profile", "--disable-3d-apis", f"--proxy-server={outside.url}", size=WINDOW
        ) as driver,
    ):
        yield Open(Page(driver), host, outside)


def test_without_the_policy_the_same_request_is_seen(bare: Open) -> None:
    """So the proxy would have seen those that the policy refused."""
    bare.page.driver.get(f"{bare.host.url}/no_policy.html")
    code = f"const done = arguments[0]; {FETCH.format('control')}.then(done)"
    assert bare.page.driver.execute_async_script(code) == "answered"
    assert ("GET", "http://elsewhere.test/control") in bare.outside.requests


def test_a_missing_camera_is_explained(bare: Open) -> None:
    bare.page.driver.get(f"{bare.host.url}/index.html")
    bare.page.click("start")
    assert until(lambda: bare.page.problem).startswith("No camera was found")
    assert bare.page.text("start") == "Start camera"


def test_a_refused_camera_is_explained_and_may_be_allowed_then(opened: Open, recorded: Recorded) -> None:
    page = opened.page
    allow_camera(page.driver, "denied")
    page.click("start")
    assert "may not use the camera" in until(lambda: page.problem)
    allow_camera(page.driver, "granted")
    page.start()
    assert page.problem == ""


def test_a_permission_that_is_withdrawn_is_explained_and_ends_the_take(opened: Open, recorded: Recorded) -> None:
    page, count = opened.page, "return document.querySelectorAll('#takes li').length"
    page.start()
    before = page.driver.execute_script(count)
    page.click("record")
    until(lambda: page.recorded_frames >= 3)
    allow_camera(page.driver, "denied")
    assert "may no longer be used" in until(lambda: page.problem)
    until(lambda: page.driver.execute_script(count) == before + 1)
    page.driver.execute_script("document.querySelector('#takes .delete').click()")
    until(lambda: page.driver.execute_script(count) == before)
    allow_camera(page.driver, "granted")
    page.start()


def test_a_take_that_the_browser_has_no_room_for_is_downloaded(opened: Open, recorded: Recorded) -> None:
    page, driver = opened.page, opened.page.driver
    page.start()
    count = "return document.querySelectorAll('#takes li').length"
    before = driver.execute_script(count)
    full = """const store = IDBObjectStore.prototype, put = store.put;
    store.put = () => { store.put = put; throw new DOMException("full", "QuotaExceededError"); };"""
    driver.execute_script(full)
    page.click("record")
    until(lambda: page.recorded_frames >= 3)
    page.click("record")
    assert "could not be kept (QuotaExceededError); it was downloaded as a .csv" in until(lambda: page.problem)
    assert driver.execute_script(count) == before
    script = "const done = arguments[0]; watched.blobs.at(-1).text().then(done)"
    assert len(driver.execute_async_script(script).split("\n")) > 3
    driver.execute_script("document.querySelector('#problem button').click()")


def test_a_face_is_lost_and_found(opened: Open, recorded: Recorded) -> None:
    page = opened.page
    page.start()
    said = "return watched.said"
    count = len(page.driver.execute_script(said))

    def lost_then_found() -> bool:
        words = page.driver.execute_script(said)[count:]
        lost = [i for i, one in enumerate(words) if one.startswith("Your face is hidden")]
        found = ("Learning your face", "Your face is followed")  # the latter where tests before have shown it for long
        return bool(lost) and any(one.startswith(found) for one in words[lost[0] :])

    until(lost_then_found)


def test_a_hidden_tab_pauses_and_goes_on_when_it_is_shown(opened: Open, recorded: Recorded) -> None:
    page, driver = opened.page, opened.page.driver
    page.start()
    count = "return watched.solved.length"
    with minimized(driver):
        until(lambda: page.text("status").startswith("Paused"))
        before = driver.execute_script(count)
        driver.execute_async_script("setTimeout(arguments[0], 600)")
        assert driver.execute_script(count) <= before + 1  # the one that was under way
    until(lambda: driver.execute_script(count) > before + 3)
    until(lambda: not page.text("status").startswith("Paused"))


def test_an_answer_that_comes_when_the_tab_is_hidden_does_not_end_the_pause(opened: Open, recorded: Recorded) -> None:
    page, driver = opened.page, opened.page.driver
    page.start()
    with page.held_pictures():
        until(lambda: driver.execute_script("return watched.held.length"))
        before = driver.execute_script("return watched.solved.length")
        with minimized(driver):
            until(lambda: page.text("status").startswith("Paused"))
            page.let_pictures_go()
            until(lambda: driver.execute_script("return watched.solved.length") > before)
            assert page.text("status").startswith("Paused")


def test_the_worker_takes_the_cameras_pictures_itself_and_rests_while_the_tab_is_hidden(
    app: Path, tmp_path: Path
) -> None:
    """Where the browser gives a stream of them; in the other tests pictures pass through the page."""
    film, count = planted_film(24), "return watched.solved.length"
    write_y4m(tmp_path / "film.y4m", film, 15)
    switches = (*film_camera(tmp_path / "film.y4m"), "--disable-3d-apis")
    with static_host(app) as host, headless_chromium(tmp_path / "profile", *switches, size=WINDOW) as driver:
        watch(driver, streamed=True)
        allow_camera(driver, "granted")
        driver.get(f"{host.url}/index.html")
        page = Page(driver)
        slide = "const e = document.getElementById('smoothing'); e.value = 0; e.dispatchEvent(new Event('input'))"
        driver.execute_script(slide)
        page.start()
        before = driver.execute_script(count)
        until(lambda: driver.execute_script(count) > before + 12)
        found = np.array(driver.execute_script("return watched.solved.slice(-10).map(s => [...s.weights])"))
        blocks = film[:, :, : BLOCK * COLUMNS].reshape(24, COLUMNS, BLOCK, COLUMNS, BLOCK).mean((2, 4))
        # A film's luma goes from 16 to 235.
        expected = ((blocks.reshape(24, -1)[:, : len(ARKIT)] - 16) / 219).clip(0, 1)
        assert abs(found[:, None] - expected).max(2).min(1).max() < 0.02
        with minimized(driver):
            until(lambda: page.text("status").startswith("Paused"))
            driver.execute_async_script("setTimeout(arguments[0], 200)")
            before = driver.execute_script(count)
            driver.execute_async_script("setTimeout(arguments[0], 600)")
            assert driver.execute_script(count) == before
        until(lambda: driver.execute_script(count) > before + 3)
        page.stop()
        page.start()
        assert driver.execute_script("return watched.sent.length") == 0


@contextmanager
def minimized(driver: Any) -> Iterator[None]:
    driver.minimize_window()
    try:
        yield
    finally:
        driver.set_window_size(*WINDOW)
